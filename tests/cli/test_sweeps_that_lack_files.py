"""Dry runs of the paper's four sweeps on miniatures: complete, and with each file missing in turn.

``docs/evidence/broken_files.md`` lists the messages.
"""

import os
import re
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from ghgs_lit.config import run_of
from ghgs_lit.data.humman import load_model
from ghgs_lit.method.model import GHGS
from ghgs_lit.weights.checkpoint import write_checkpoint
from scripts.miniatures import humman, thuman2, zju_mocap
from tests.cli.test_main import call
from tests.helpers.captures import make_miniature

VIT = "vit: {depth: 2, heads: 2}"
ENCODER = f"encoder={{width: 32, heads: 2, depth: 4, layers: [0, 1, 2, 3], image_size: 28, {VIT}}}"
SMALL = (ENCODER, "data.size=28", "data.workers=0", "trainer=cpu", "logger=none", "callbacks=none")
COMMAND = ("data.root=${data.name}", "init_from=vggt.ckpt", "seed=1", "hydra.sweep.dir=sweep", "dry_run=true")
BODY = r"expected body vertices for loss\.weights\.chamfer=1\.0 \(0 does without\); found none"
FILE = r"expected a file of the data set; found none"
FOLDER = r"expected the folder of the data set; found no such folder"

# Deleted files; the sweep and its other overrides; expected messages.
CASES = {
    # ZJU-MoCap and HuMMan: table 1
    "photograph": ("zju_mocap/*386/Camera_B3/*", "table1", [rf"386/Camera_B3/000000\.jpg: {FILE}"]),
    "masks": ("zju_mocap/*386/mask_cihp", "table1", [rf"000000\.png: {FILE} \(and 19 more like it\)"]),
    "mask": ("zju_mocap/*377/mask_cihp/Camera_B1/*", "table1", [rf"Camera_B1/000000\.png: {FILE}"]),
    "cameras": ("zju_mocap/*386/annots.npy", "table1", [r"386/annots\.npy: expected an \.npy file; found"]),
    "body": ("zju_mocap/*386/new_vertices/*", "table1", [rf"386/new_vertices/0\.npy: {BODY}"]),
    "bodies": ("zju_mocap/*386/*vertices", "table1", [rf"386/new_vertices/0\.npy: {BODY}"]),
    "test": ("zju_mocap/*377", "table1", [r"zju_mocap: expected sequences such as CoreView_377; found none"]),
    "data": ("zju_mocap", "table1", [rf"zju_mocap: {FOLDER}"]),
    "HuMMan's mask": ("humman/p1*/kinect_mask/*_003/*", "table1", [rf"kinect_003/000000\.png: {FILE}"]),
    "HuMMan's masks": ("humman/p0*/kinect_mask", "table1", [rf"000000\.png: {FILE} \(and 9 more like it\)"]),
    "HuMMan's photographs": ("humman/p1*/kinect_color", "table1", [r"color: expected frames such as"]),
    "HuMMan's input": ("humman/p0*/*color/*_002/*", "table1", [r"expected ring positions .* no position 2"]),
    "HuMMan's cameras": ("humman/p0*/cameras.json", "table1", [r"cameras\.json: expected the cameras of"]),
    "HuMMan's body": ("humman/p1*/smpl_params/*", "table1", [rf"smpl_params/000000\.npz: {BODY}"]),
    "HuMMan's training": ("humman/p1*", "table1", [r"humman: expected sequences beside those of val"]),
    "body model": ("*/smpl/*.pkl", "table1", [r"body_models: expected SMPL_NEUTRAL\.pkl, or .* neither"]),
    "option of it": ("", "table1 experiment=humman data.smpl_model=null", [rf"data\.smpl_model: {BODY}"]),
    "both": ("*m[ao][nc]*", "table1", [rf"zju_mocap: {FOLDER}", rf"humman: {FOLDER}"]),
    # THuman2.0: tables 2 to 4
    "its photograph": ("thuman2/train/img/*_003/0.jpg", "table2", [rf"0000_003/0\.jpg: {FILE}"]),
    "its photographs": ("thuman2/train/img", "table3", [r"train/img: expected a folder <id>_<position>"]),
    "its mask": ("thuman2/val/mask/*_002/1.png", "table4", [rf"0426_002/1\.png: {FILE}"]),
    "its masks": ("thuman2/train/mask", "table3", [rf"0\.png: {FILE} \(and 79 more like it\)"]),
    "its lens": ("thuman2/train/parm/*_001/0_intr*", "table3", [rf"0_intrinsic\.npy: {FILE}"]),
    "its poses": ("thuman2/*/parm/*/*extr*", "table3", [rf"train.*_extrinsic.*: {FILE}", rf"val.*: {FILE}"]),
    "its body": ("thuman2/train/smpl/*/vertices.npy", "table3", [rf"smpl/0000/vertices\.npy: {BODY}"]),
    "its test people": ("thuman2/val", "table4", [r"val/img: expected a folder <id>_<position>"]),
    "all kinds": (
        "thuman2/train/[mps]*/*/*",
        "table3",
        [rf"mask/.*: {FILE}", rf"intrinsic\.npy: {FILE}", rf"extrinsic\.npy: {FILE}", BODY],
    ),
    # Other than data
    "weights": ("vggt.ckpt", "table2", [r"vggt\.ckpt: expected a file of weights; found none"]),
    "weights and data": ("[tv]*", "table4", [r"vggt\.ckpt: expected", rf"thuman2: {FOLDER}"]),
    "import": ("", "table3 init_from=null", [r"init_from: expected a checkpoint with the encoder's weights"]),
    "LPIPS": ("", "table3 metrics.lpips=require", [r"LPIPS: expected the package torchvision"]),
    "cache": (
        "",
        "table3 feature_cache.kind=disk feature_cache.folder=vggt.ckpt/cache",
        [r"feature_cache\.folder: vggt\.ckpt/cache: expected a folder that can be written"],
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """Miniatures of the three data sets, a body model and weights of the encoder."""
    folder = tmp_path_factory.mktemp("whole")
    thuman2.make(folder / "thuman2", {"train": 1, "val": 1}, 64, 3)
    make_miniature(zju_mocap, folder / "zju_mocap", ["386", "377"], 64, 3, 1)
    make_miniature(humman, folder / "humman", ["p000455_a000986"], {"train": 1, "val": 1}, 64, 3, [0])
    config = run_of("train", ["experiment=thuman2", *SMALL]).plain
    state = GHGS.from_config(config).state_dict()
    encoder = {key: value for key, value in state.items() if key.startswith("encoder.")}
    write_checkpoint(folder / "vggt.ckpt", encoder, config)
    return folder


@pytest.fixture
def dry_run(monkeypatch, capsys, tmp_path, whole):
    """``dry_run(deleted, "table3 key=value")``: exit code, output and errors of a sweep's dry run."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SMPL_MODEL", "humman_body_models")
    monkeypatch.setitem(sys.modules, "torchvision", None)
    body = SimpleNamespace(vertices=torch.rand(1, 6890, 3))
    model = SimpleNamespace(eval=lambda: lambda **parameters: body)
    package = SimpleNamespace(Struct=lambda **arrays: arrays, SMPL=lambda *arguments, **options: model)
    for module in ("smplx", "smplx.utils"):
        monkeypatch.setitem(sys.modules, module, package)
    load_model.cache_clear()
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True, copy_function=os.link)

    def run(deleted: str, words: str) -> tuple[int, str, str]:
        for path in sorted(tmp_path.glob(deleted)) if deleted else ():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        sweep, *changes = words.split()
        there = {path.relative_to(tmp_path) for path in tmp_path.rglob("*")}
        answer = call(monkeypatch, capsys, "train", f"sweep={sweep}", *SMALL, *COMMAND, *changes)
        assert {path.relative_to(tmp_path) for path in tmp_path.rglob("*")} == there  # nothing was written
        return answer

    return run


@pytest.mark.parametrize("sweep", ["table1", "table2", "table3", "table4"])
def test_a_sweep_whose_files_are_there_is_planned(dry_run, sweep):
    """The plan is printed, with warnings of the readers at most."""
    code, out, err = dry_run("", sweep)
    assert code == 0, err
    assert "would be refused" not in out
    warnings = re.findall(r"(\w+: \d+) of \d+ sequences of (train|val) are there", out + err)
    # The miniatures have one sequence per phase; HuMMan's training uses all that exist.
    few = {("zju_mocap: 1", "train"), ("zju_mocap: 1", "val"), ("humman: 1", "val")}
    assert set(warnings) == (few if sweep == "table1" else set())


@pytest.mark.parametrize("case", CASES)
def test_each_file_that_lacks_is_one_line_before_training(dry_run, case):
    """Path, expected and found, for all files at once; exit code 1, nothing written, no traceback."""
    deleted, words, expected = CASES[case]
    code, out, err = dry_run(deleted, words)
    refused = re.findall(r"^would be refused: (.*)$", out, re.MULTILINE)
    assert code == 1
    assert len(refused) == len(expected), refused
    for pattern in expected:
        assert any(re.search(pattern, line) for line in refused), (pattern, refused)
    assert err.count("\n") == 1
    assert err.startswith(f"ghgs train: dry_run: expected runs that lack nothing; found {len(expected)} ")


def test_depth_maps_are_not_needed(dry_run):
    """The paper's loss reads no depth maps; the depth error in tables is omitted."""
    code, out, _ = dry_run("thuman2/*/depth", "table3")
    assert code == 0, out
