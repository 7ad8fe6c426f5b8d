"""A custom data set from the documentation's template: registered, trained and evaluated from the
command line."""

import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from ghgs_lit.config import build, registry
from ghgs_lit.data.check import inspect
from ghgs_lit.errors import InputError
from tests.helpers.training import ring
from tests.helpers.verbs import ghgs

TEMPLATE = Path(__file__).parents[2] / "docs" / "template"
CAMERAS, SIZE = 8, 60
KEYS = {
    "views": {"training_counts": [3], "evaluation_count": 3},
    "targets": {"name": "cameras", "view": 0, "training_views": [0]},
}


@pytest.fixture
def project(tmp_path):
    """A user's folder with one Python file, one YAML file and a toy data set."""
    shutil.copy(TEMPLATE / "my_people.py", tmp_path / "my_people.py")
    shutil.copytree(TEMPLATE / "conf", tmp_path / "conf")
    cameras = ring(CAMERAS, SIZE)
    rng = np.random.default_rng(0)
    for phase, names in (("train", "ab"), ("val", "c")):
        for name in names:
            folder = tmp_path / "photographs" / phase / name
            folder.mkdir(parents=True)
            color = rng.integers(60, 255, 3)
            for camera in range(CAMERAS):
                pixels = np.zeros((SIZE, SIZE, 4), np.uint8)
                pixels[10:50, 22:38] = (*color, 255)
                Image.fromarray(pixels).save(folder / f"{camera}.png")
            np.savez(
                folder / "cameras.npz", intrinsics=cameras.intrinsics, extrinsics=cameras.extrinsics[:, :3]
            )
            np.save(folder / "body.npy", rng.uniform(-1, 1, (50, 3)) * [0.2, 0.6, 0.2])
    return tmp_path


@pytest.fixture(autouse=True)
def clean(monkeypatch):
    """Start each test without registered or imported plug-ins."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delenv(registry.VARIABLE, raising=False)
    monkeypatch.setattr(registry, "_REGISTERED", dict(registry._REGISTERED))
    registry._installed_plugins.cache_clear()
    yield
    registry._installed_plugins.cache_clear()
    for name in ("my_people", "numbers_of_mine"):
        sys.modules.pop(name, None)


def node(project: Path, **changes) -> dict:
    about = {"kind": "my_people", "name": "m", "root": str(project / "photographs")}
    return {**about, "size": 56, **changes}


def test_one_file_and_one_yaml_are_trained_and_measured(project, monkeypatch, capsys):
    """The documentation's commands train and evaluate on the data set."""
    monkeypatch.chdir(project)
    monkeypatch.setenv(registry.VARIABLE, "my_people.py")
    code = ghgs(
        "train", "--config-dir", "conf", "data=my_people", "data.root=photographs", "data.size=56",
        "views=v3", "targets=cameras", "evaluation.targets=[cameras]", "trainer.max_steps=2",
        "evaluation.pictures=0", "logger=none", "callbacks=none", "hydra.run.dir=run",
    )  # fmt: skip
    assert code == 0
    content = json.loads(Path("run/metrics.json").read_text())
    assert content["provenance"]["data"] == {"name": "my_people", "resampling": "area", "split": "val"}
    assert content["provenance"]["training"]["steps"] == 2
    # One subject, with every camera that is not an input as a target.
    before = {row["target"]: row["psnr"] for row in content["rows"]}
    assert {row["subject"] for row in content["rows"]} == {"c"}
    assert len(before) == CAMERAS - 3
    assert np.isfinite(list(before.values())).all()
    # The checkpoint can be evaluated only with the plug-in.
    arguments = [
        "evaluate", "checkpoint=run/checkpoints/last.ckpt", "views=v3", "targets=cameras",
        "evaluation.targets=[cameras]", "evaluation.pictures=0", "hydra.run.dir=measured",
    ]  # fmt: skip
    monkeypatch.delenv(registry.VARIABLE)
    del registry._REGISTERED["data", "my_people"]
    sys.modules.pop("my_people")
    assert ghgs(*arguments) == 1
    said = capsys.readouterr().err
    assert "data.kind: expected one of" in said
    assert registry.VARIABLE in said
    monkeypatch.setenv(registry.VARIABLE, "my_people.py")
    assert ghgs(*arguments) == 0
    again = json.loads(Path("measured/metrics.json").read_text())
    assert {row["target"]: row["psnr"] for row in again["rows"]} == pytest.approx(before, abs=1e-3)


def test_the_template_passes_the_check(project, monkeypatch):
    """task=check requires only the static cameras, whatever the protocol's views, and counts the bodies."""
    monkeypatch.setenv(registry.VARIABLE, str(project / "my_people.py"))
    release = {"name": "release", "training_views": [2, 3, 4]}
    report = inspect(build(node(project), "data", **KEYS | {"targets": release}))
    assert report.problems == report.notes == []
    assert [figures["bodies"] for figures in report.phases.values()] == [2, 1]


def test_the_template_gives_batches_of_the_photographs(project, monkeypatch):
    """Batches contain the template's cameras, masks and bodies; missing views and files are rejected."""
    monkeypatch.setenv(registry.VARIABLE, str(project / "my_people.py"))
    data = build(node(project), "data", **KEYS)
    (batch,) = list(data.evaluation_loader())
    assert batch.images.shape == (1, 3, 3, 56, 56)
    assert len(batch.body_vertices[0]) == 50
    expected = ring(CAMERAS, 56)
    assert torch.allclose(batch.cameras.intrinsics[0], expected.intrinsics[[0, 2, 5]], atol=1e-4)
    assert torch.allclose(batch.cameras.extrinsics[0], expected.extrinsics[[0, 2, 5]], atol=1e-5)
    assert batch.masks.float().mean().item() == pytest.approx(40 * 16 / 60**2, abs=0.01)
    # Other processes can import the class, too.
    assert str(project) in sys.path
    between = {"name": "cameras", "view": 3}
    with pytest.raises(InputError, match="found cameras, which asks for views between cameras"):
        list(build(node(project), "data", **KEYS | {"targets": between}).evaluation_loader())
    (project / "photographs" / "val" / "c" / "cameras.npz").unlink()
    with pytest.raises(InputError, match=r"c/cameras\.npz"):
        list(build(node(project), "data", **KEYS).evaluation_loader())


def test_nothing_is_admitted_by_a_configuration(project):
    """A configuration, such as that of a downloaded checkpoint, cannot import foreign code."""
    for kind in ("my_people", "my_people.MyPeople", "os.system"):
        with pytest.raises(InputError, match=r"data\.kind: expected one of"):
            build(node(project, kind=kind), "data")
    assert "my_people" not in sys.modules


def test_a_module_and_an_installed_package_can_be_admitted(project, monkeypatch):
    """Both documented ways to load plug-ins register their kinds."""
    monkeypatch.syspath_prepend(str(project))
    points = {registry.GROUP: [SimpleNamespace(value="my_people")]}
    for admit in (
        lambda: monkeypatch.setenv(registry.VARIABLE, "my_people"),
        lambda: monkeypatch.setattr(
            registry.importlib.metadata, "entry_points", lambda group: points.get(group, [])
        ),
    ):
        with pytest.raises(InputError, match="my_people"):
            build(node(project), "data")
        admit()
        registry._installed_plugins.cache_clear()
        assert build(node(project), "data", **KEYS).dataset.name == "m"
        monkeypatch.delenv(registry.VARIABLE, raising=False)
        del registry._REGISTERED["data", "my_people"]
        sys.modules.pop("my_people")
        registry._installed_plugins.cache_clear()


def test_a_bad_plugin_is_refused_with_its_path(tmp_path, monkeypatch):
    """A wrong GHGS_PLUGINS is reported with its file, and an error inside the file is not hidden."""
    for name, said in (
        ("none.py", r"found .*none\.py"),
        ("json.py", "no other module has"),
    ):
        if name != "none.py":
            (tmp_path / name).write_text("")
        monkeypatch.setenv(registry.VARIABLE, str(tmp_path / name))
        with pytest.raises(InputError, match=said):
            build({"kind": "x"}, "bounds")
    # An error in the user's file is raised unchanged.
    (tmp_path / "numbers_of_mine.py").write_text("1 / 0")
    monkeypatch.setenv(registry.VARIABLE, str(tmp_path / "numbers_of_mine.py"))
    with pytest.raises(ZeroDivisionError):
        build({"kind": "y"}, "bounds")
