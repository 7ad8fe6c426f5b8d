"""The script that trains the matting network: its samples,
and that a run goes on where it ended."""

import importlib.util
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from ghgs_lit.data.matting import MattingNetwork

SCRIPT = Path(__file__).resolve().parents[3] / "scripts" / "bake_matting.py"


@pytest.fixture(scope="module")
def bake():
    spec = importlib.util.spec_from_file_location("bake_matting", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def subject():
    """A soft ellipse on black: its premultiplied colours and its matte."""
    v, u = np.mgrid[:252, :252]
    alpha = ((1 - ((v - 126) / 100) ** 2 - ((u - 120) / 40) ** 2) * 20 + 0.5).clip(0, 1).astype(np.float32)
    colors = np.stack((v / 252, u / 252, 0.7 + 0 * u)).astype(np.float32)
    return colors * alpha, alpha


def test_samples_show_the_subject_before_a_background(bake):
    """What is sure of the subject is its colour, but for noise; backgrounds and masks differ."""
    photographs, errors = [], []
    for seed in range(40):
        photograph, given, matte, image = bake.sample(*subject(), np.random.default_rng(seed))
        assert all(part.dtype == np.float32 for part in (photograph, given, matte, image))
        assert photograph.shape == image.shape == (3, 160, 160)
        assert given.shape == matte.shape == (160, 160)
        assert photograph.min() >= 0
        assert photograph.max() <= 1
        assert 0.1 < matte.mean() < 0.9
        inside = matte > 0.999
        assert np.abs(photograph - image)[:, inside].mean() < 0.05
        assert np.abs(photograph)[:, matte == 0].mean() > 0.05
        photographs.append(photograph)
        errors.append(np.abs(given - matte).mean())
    assert min(errors) == 0
    assert max(errors) > 0.02
    again = bake.sample(*subject(), np.random.default_rng(39))[0]
    assert (again == photographs[-1]).all()
    assert (again != photographs[0]).any()


@pytest.mark.filterwarnings("ignore")
def test_runs_go_on_where_they_ended(bake, tmp_path, monkeypatch):
    """Steps see their own photographs whatever was run before;
    the weights are those of a network."""
    monkeypatch.setattr(bake, "_CROP", 32)
    monkeypatch.setattr(bake, "_KEPT", 1)
    seen = []

    def training_batch(step):
        if step == 2 and seen == [0]:
            raise InterruptedError
        image, alpha = (torch.from_numpy(part)[None, None] for part in subject())
        return SimpleNamespace(images=image, alpha=alpha)

    original = bake.Samples.__init__

    def record(self, data, first):
        seen.append(first)
        original(self, data, first)

    monkeypatch.setattr(bake.Samples, "__init__", record)
    data, weights = SimpleNamespace(training_batch=training_batch), tmp_path / "weights.safetensors"
    with pytest.raises(InterruptedError):
        bake.train(data, 4, tmp_path, weights)
    assert not weights.exists()
    bake.train(data, 4, tmp_path, weights)
    assert seen[1] in (1, 2)
    MattingNetwork().load_state_dict(load_file(weights))
    assert torch.load(tmp_path / "last.ckpt", weights_only=True)["global_step"] == 4
