"""Broken files of SMPL: each defect of parameters and models raises one line with its place."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from ghgs_lit.data.smpl import read_model, read_parameters
from scripts.miniatures.smpl import stand_in
from tests.helpers.captures import Malice, refused, truncate

GOOD = {"betas": np.zeros(10), "body_pose": np.zeros(69), "global_orient": np.zeros(3), "transl": np.zeros(3)}
PARAMETERS = {
    "malicious": ({**GOOD, "betas": np.array(Malice(), object)}, "expected an .npz file of arrays; found"),
    "without transl": ({k: v for k, v in GOOD.items() if k != "transl"}, "expected transl; found"),
    "of SMPL-X": ({**GOOD, "body_pose": np.zeros(63)}, "body_pose: expected an array 69; found 63"),
    "NaN": ({**GOOD, "transl": np.full(3, np.nan)}, "transl: expected finite numbers; found NaN or infinity"),
}


@pytest.mark.parametrize("case", PARAMETERS)
def test_broken_parameters_get_their_line(case, tmp_path, monkeypatch):
    """Bad SMPL parameters are named and never executed."""
    monkeypatch.chdir(tmp_path)
    content, line = PARAMETERS[case]
    np.savez("000000.npz", **content)
    refused(f"000000.npz.*{line}", lambda: read_parameters(tmp_path / "000000.npz"))


def test_missing_and_truncated_parameters_get_their_line(tmp_path):
    """A missing or truncated file is named."""
    path = tmp_path / "000000.npz"
    refused(r"000000.npz: expected SMPL parameters; found no such file", lambda: read_parameters(path))
    np.savez(path, **GOOD)
    truncate(path)
    refused(r"000000.npz: expected an .npz file of arrays; found", lambda: read_parameters(path))


MODELS = {
    "malicious": (
        {**stand_in(), "f": Malice()},
        "expected a pickle of NumPy arrays and plain containers; found posix.system",
    ),
    "of SMPL-X": (
        {**stand_in(), "v_template": np.zeros((10475, 3))},
        "v_template: expected an array 6890x3; found 10475x3",
    ),
    "a list": ([1, 2], "expected the arrays of an SMPL model; found list"),
}


@pytest.mark.parametrize("case", MODELS)
def test_a_broken_model_gets_its_line(case, tmp_path, monkeypatch):
    """A wrong model file is named and never executed."""
    monkeypatch.chdir(tmp_path)
    content, line = MODELS[case]
    Path("SMPL_NEUTRAL.pkl").write_bytes(pickle.dumps(content))
    refused(f"SMPL_NEUTRAL.pkl: {line}", lambda: read_model(tmp_path / "SMPL_NEUTRAL.pkl"))
