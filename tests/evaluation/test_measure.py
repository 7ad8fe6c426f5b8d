"""Measuring, splats on disk, turntables, and the verbs from end to end on rendered boxes."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from ghgs_lit.cli.main import main
from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.measure import Estimate, ModelMethod, measure
from ghgs_lit.export.ply import read_ply, write_ply
from ghgs_lit.metrics import ImageMetrics, psnr
from ghgs_lit.model import GHGS
from ghgs_lit.rendering import render
from ghgs_lit.runs.provenance import config_hash
from ghgs_lit.types import Gaussians
from ghgs_lit.visualization.turntable import look_at_point, turntable
from tests.helpers.people import render_boxes
from tests.helpers.training import Standin, example_batch, flat_renderer, ring

OFF = ImageMetrics(lpips="off")


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Images this small gain nothing from threads, and lose much where the cores are shared."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_rows_say_what_they_are_about_and_hold_the_metrics(tmp_path):
    batch = example_batch(subjects=2, views=3, targets=2)
    rows = measure(ModelMethod(Standin(), flat_renderer), "model", [batch], "midway", OFF, "cpu", tmp_path, 1)
    assert [(r["subject"], r["target"]) for r in rows] == [
        ("p0", "000/3"), ("p0", "001/3"), ("p1", "000/3"), ("p1", "001/3"),
    ]  # fmt: skip
    assert {(r["method"], r["views"], r["targets"]) for r in rows} == {("model", 3, "midway")}
    assert rows[0]["inputs"] == ["000/0", "001/0", "002/0"]
    image = flat_renderer(Standin()(batch).gaussians, batch.targets.cameras).image
    expected = psnr(image[1, 1][None].clamp(0, 1), batch.targets.images[1, 1][None]).item()
    assert rows[3]["psnr"] == pytest.approx(expected)
    # the stand-in says 2.5 m, the truth is 2.1 m
    assert rows[0]["depth_error_mm"] == pytest.approx(400, abs=1e-2)
    assert rows[0]["gaussians"] == 144
    assert [p.name for p in tmp_path.iterdir()] == ["model_v3_midway_p0.png"]


def test_a_perfect_method_reaches_the_cap_and_has_no_depth():
    batch = example_batch()
    rows = measure(lambda b: Estimate(b.targets.images), "perfect", [batch], "release", OFF)
    assert rows[0]["psnr"] == pytest.approx(100)
    assert rows[0]["flip"] == 0
    assert rows[0]["depth_error_mm"] is None


def gaussians(n=50, seed=0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(n, 3, generator=g) * 0.3,
        quaternions=torch.randn(n, 4, generator=g) * 3,
        scales=torch.rand(n, 3, generator=g) * 0.05 + 0.01,
        opacities=torch.rand(n, generator=g) * 0.9 + 0.05,
        colors=torch.rand(n, 3, generator=g),
        splits=(n,),
    )


def test_a_ply_renders_as_what_was_written(tmp_path):
    written = gaussians()
    write_ply(written, tmp_path / "a.ply")
    read = read_ply(tmp_path / "a.ply")
    for name in ("means", "scales", "opacities", "colors"):
        assert torch.allclose(getattr(read, name), getattr(written, name), atol=1e-5)
    assert torch.allclose(read.quaternions.norm(dim=-1), torch.ones(50), atol=1e-6)
    cameras = ring(2, 24)[None]
    a, b = (render(g, cameras, backend="reference").image for g in (written, read))
    assert a.max() > 0.2
    assert torch.allclose(a, b, atol=1e-4)


def test_a_ply_has_the_names_and_units_of_3dgs(tmp_path):
    plyfile = pytest.importorskip("plyfile")
    one = Gaussians(
        torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[2.0, 0, 0, 0]]), torch.tensor([[0.1, 1.0, 0.0]]),
        torch.tensor([0.5]), torch.tensor([[0.5, 1.0, 0.0]]), (1,),
    )  # fmt: skip
    write_ply(one, tmp_path / "one.ply")
    vertex = plyfile.PlyData.read(tmp_path / "one.ply")["vertex"]
    value = {p.name: float(vertex[p.name][0]) for p in vertex.properties}
    assert [value[n] for n in ("x", "y", "z", "rot_0", "rot_1")] == [1, 2, 3, 1, 0]
    assert value["opacity"] == pytest.approx(0, abs=1e-6)
    assert value["scale_0"] == pytest.approx(np.log(0.1), rel=1e-6)
    assert np.isfinite(value["scale_2"])
    assert value["f_dc_0"] == pytest.approx(0, abs=1e-6)
    assert value["f_dc_1"] == pytest.approx(0.5 / 0.28209479177387814, rel=1e-6)
    nothing = one.select(slice(0, 0), (0,))
    write_ply(nothing, tmp_path / "none.ply")
    assert len(read_ply(tmp_path / "none.ply")) == 0
    with pytest.raises(InputError, match="one subject"):
        write_ply(one.select(slice(0, 1), (1, 0)), tmp_path / "two.ply")
    (tmp_path / "no.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n"
    )
    with pytest.raises(InputError, match=r"no\.ply"):
        read_ply(tmp_path / "no.ply")


def test_a_turntable_of_a_ring_is_the_ring():
    cameras = ring(4, 20)
    assert torch.allclose(look_at_point(cameras), torch.zeros(3, dtype=torch.float64), atol=1e-6)
    orbit = turntable(cameras[torch.tensor([0, 2])], 4)
    assert torch.allclose(orbit.extrinsics[0], cameras.extrinsics[0], atol=1e-5)
    assert torch.allclose(orbit.extrinsics[2], cameras.extrinsics[2], atol=1e-5)
    assert torch.allclose(torch.linalg.det(orbit.extrinsics[:, :3, :3]), torch.ones(4), atol=1e-5)
    assert torch.allclose(orbit.centers.norm(dim=-1), torch.full((4,), 2.0), atol=1e-5)


def test_the_hash_of_a_configuration_ignores_the_order_of_keys():
    assert config_hash({"a": 1, "b": {"c": [1, 2]}}) == config_hash({"b": {"c": [1, 2]}, "a": 1})
    assert config_hash({"a": 1}) != config_hash({"a": 2})


@pytest.fixture(scope="module")
def boxes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("boxes")
    render_boxes(folder / "rendered", folder / "scans", train=3, val=2)
    return folder / "rendered"


def ghgs(*arguments: str) -> int:
    """The console script in this process."""
    before = sys.argv
    sys.argv = ["ghgs", *arguments]
    # The script sets it for Hydra; where a user has set it, errors are raised.
    os.environ.pop("HYDRA_FULL_ERROR", None)
    try:
        return main()
    except SystemExit as exit:
        return exit.code
    finally:
        sys.argv = before


@pytest.fixture(scope="module")
def trained(boxes, tmp_path_factory):
    """A run of three steps with everything on."""
    directory = tmp_path_factory.mktemp("train") / "run"
    code = ghgs(
        "train", *data_of(boxes), "trainer.max_steps=3", "trainer.val_check_interval=2", "loss=depth",
        "evaluation.views=[3,4]", "evaluation.pictures=1", f"hydra.run.dir={directory}",
    )  # fmt: skip
    assert code == 0
    return directory


def data_of(root) -> list[str]:
    return ["data=scans", f"data.root={root}", "data.size=42"]


def test_train_writes_everything_that_it_promises(trained):
    files = {p.relative_to(trained).as_posix() for p in trained.rglob("*") if p.is_file()}
    expected = {
        "metrics.json", "metrics.csv", "config.yaml", "checkpoints/last.ckpt", "checkpoints/best.ckpt",
        "csv/metrics.csv", "pictures/model_v3_release_s3.png", "pictures/model_v4_midway_s3.png",
    }  # fmt: skip
    assert expected <= files
    assert any(name.startswith("tensorboard/events") for name in files)
    assert not [name for name in files if "=" in name or name.endswith(".tmp")]
    content = json.loads((trained / "metrics.json").read_text())
    assert len(content["rows"]) == 2 * 2 * 2  # subjects, numbers of views, kinds of targets
    source = content["provenance"]
    assert source["protocol"]["metrics"] == "correct"
    assert source["training"]["steps"] == 3
    assert source["config_hash"] == config_hash(source["config"])
    assert source["choices"]["loss"] == "depth"
    assert source["parameters"]["total"] > 0
    assert np.asarray(Image.open(trained / "pictures" / "model_v3_release_s3.png")).max() > 100


def test_a_checkpoint_measures_the_same_again_beside_the_baselines(trained, boxes, tmp_path):
    path = trained / "checkpoints" / "last.ckpt"
    code = ghgs(
        "evaluate", *data_of(boxes), f"checkpoint={path}", "baselines=all", "evaluation.views=[3]",
        "evaluation.pictures=0", f"hydra.run.dir={tmp_path / 'run'}",
    )  # fmt: skip
    assert code == 0
    content = json.loads((tmp_path / "run" / "metrics.json").read_text())
    before = json.loads((trained / "metrics.json").read_text())
    value = {(r["method"], r["subject"], r["targets"]): r for r in content["rows"]}
    for row in before["rows"]:
        if row["views"] == 3:
            again = value["model", row["subject"], row["targets"]]
            assert again["psnr"] == pytest.approx(row["psnr"], abs=1e-3)
    methods = {"model", "black", "nearest_view", "body_depth", "true_depth", "untrained"}
    assert {r["method"] for r in content["rows"]} == methods
    assert value["true_depth", "s3", "midway"]["psnr"] > value["black", "s3", "midway"]["psnr"] + 3


def test_predict_writes_a_splat_that_renders_and_a_turntable(trained, boxes, tmp_path):
    path = trained / "checkpoints" / "last.ckpt"
    arguments = [
        *data_of(boxes),
        f"checkpoint={path}",
        "turntable.frames=3",
        f"hydra.run.dir={tmp_path / 'r'}",
    ]
    assert ghgs("predict", *arguments, "subject=1") == 0
    assert len(read_ply(tmp_path / "r" / "s4.ply")) > 50
    assert len(list((tmp_path / "r" / "turntable").glob("*.png"))) == 3
    assert np.asarray(Image.open(tmp_path / "r" / "turntable" / "000.png")).max() > 50
    assert ghgs("predict", *arguments, "subject=nobody") == 1


def test_a_sweep_becomes_a_table(boxes, tmp_path):
    quick = ["callbacks=none", "logger=none", "trainer.max_steps=1", "evaluation.pictures=0"]
    code = ghgs(
        "train", "-m", *data_of(boxes), *quick, "ablation=full,neither", "model=paper",
        "evaluation.targets=[release]", "metrics=release", f"hydra.sweep.dir={tmp_path / 'sweep'}",
    )  # fmt: skip
    assert code == 0
    assert ghgs("table", f"runs={tmp_path / 'sweep'}", f"hydra.run.dir={tmp_path / 'table'}") == 0
    text = (tmp_path / "table" / "table.md").read_text()
    assert "metrics `release`, model `paper`, encoder `vggt_nano`" in text
    assert text.count("missing") == 2 * 9 + 2 * 6
    assert r"\begin{tabular}" in (tmp_path / "table" / "table.tex").read_text()
    assert (tmp_path / "table" / "table.csv").read_text().count(",full,") == 9
    # The directory under the name that is a group of `train`, too; the paper's layout; a bad one.
    again = ["table", f"sweep=[{tmp_path / 'sweep'}]", f"hydra.run.dir={tmp_path / 'second'}"]
    assert ghgs(*again, "layout=table2", "columns=psnr_box", "test.kind=t") == 1
    assert ghgs(*again, "layout=table2", "columns=psnr", "test.kind=t", r'test.unit="(.+)"') == 0
    assert "RoGSplat" in (tmp_path / "second" / "table.md").read_text()
    for wrong in ("layout=table9", "evaluation.views=four", "test.kind=anova", "test.unit=x", "test.unt=1"):
        assert ghgs(*again, wrong) == 1
    # Jobs that share a process cannot start others.
    assert ghgs("train", "-m", *data_of(boxes), *quick, "seed=1,2", "trainer=ddp_cpu") == 1


def test_bad_input_of_the_verbs_is_one_line(boxes, tmp_path, capsys):
    where = f"hydra.run.dir={tmp_path / 'run'}"
    assert ghgs("evaluate", *data_of(boxes), where) == 1
    assert "checkpoint: expected" in capsys.readouterr().err
    assert ghgs("evaluate", *data_of(boxes), "checkpoint=/none.ckpt", where) == 1
    assert ghgs("train", *data_of(boxes), "trainer.max_time=ten", where) == 1
    assert "ten" in capsys.readouterr().err
    assert ghgs("train", *data_of(boxes), "trainer.max_steps=-1", where) == 1
    assert not (tmp_path / "run" / "metrics.json").exists()


def test_two_processes_train_together_and_write_once(boxes, tmp_path):
    directory = tmp_path / "run"
    command = [
        sys.executable, "-m", "ghgs_lit", "train", *data_of(boxes), "trainer=ddp_cpu", "trainer.max_steps=2",
        "evaluation.pictures=0", "evaluation.targets=[release]", f"hydra.run.dir={directory}",
    ]  # fmt: skip
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.count("wrote ") == 1
    # events.out.tfevents.<time>.<host>.<process>.<number>
    assert len({p.name.split(".")[-2] for p in directory.rglob("events*")}) == 1
    content = json.loads((directory / "metrics.json").read_text())
    assert content["provenance"]["training"] | {"seconds": 0} == {"steps": 2, "seconds": 0, "processes": 2}
    assert GHGS.from_checkpoint(directory / "checkpoints" / "last.ckpt") is not None
