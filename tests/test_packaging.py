"""The configuration is found in a wheel, in an editable install and in a checkout."""

import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

REPOSITORY = Path(__file__).resolve().parents[1]
FIND = "from ghgs_lit.config import conf_dir; print(conf_dir())"


def find_conf(cwd: Path, pythonpath: Path | None) -> Path:
    env = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    if pythonpath is not None:
        env["PYTHONPATH"] = str(pythonpath)
    done = subprocess.run(
        [sys.executable, "-c", FIND], cwd=cwd, env=env, capture_output=True, text=True, check=True
    )
    return Path(done.stdout.strip())


def groups(conf: Path) -> set[str]:
    return {str(path.relative_to(conf)) for path in conf.rglob("*.yaml")}


def test_wheel_carries_the_configuration_and_assets(tmp_path):
    """A wheel without ``conf`` or the body model would fail at first use."""
    pytest.importorskip("hatchling")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path / "dist")],
        cwd=REPOSITORY,
        check=True,
        capture_output=True,
    )
    site = tmp_path / "site"
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    conf = find_conf(tmp_path, site)
    assert conf == (site / "ghgs_lit" / "conf").resolve()
    assert groups(conf) == groups(REPOSITORY / "conf")
    assert (site / "hydra_plugins" / "ghgs_lit_sweeper.py").is_file()
    assets = Path("ghgs_people", "figures", "assets")
    shipped, packed = (
        {p.name for p in (root / assets).iterdir() if p.is_file()} for root in (REPOSITORY, site)
    )
    assert shipped == packed


def test_editable_install(tmp_path):
    """Developers get the checkout's ``conf`` rather than an installed copy."""
    assert find_conf(tmp_path, None) == REPOSITORY / "conf"


def test_checkout(tmp_path):
    """The package runs from a copy of the repository that is not installed."""
    for name in ("ghgs_lit", "conf"):
        shutil.copytree(REPOSITORY / name, tmp_path / "copy" / name)
    assert find_conf(tmp_path, tmp_path / "copy") == (tmp_path / "copy" / "conf").resolve()


def requirements() -> dict[str, Requirement]:
    """Requirements of the package and its extras, by name."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    lines = [
        *project["dependencies"],
        *(line for extra in project["optional-dependencies"].values() for line in extra),
    ]
    return {requirement.name: requirement for requirement in map(Requirement, lines)}


def test_the_versions_that_make_installs_are_allowed():
    """``constraints.txt`` must not contradict the version ranges of the package."""
    lines = (REPOSITORY / "constraints.txt").read_text().splitlines()
    exact = dict(line.split("==") for line in lines if not line.startswith("#"))
    known = {name.replace("_", "-"): each for name, each in requirements().items()}
    assert {"torch", "hydra-core", "pillow"} <= known.keys() & exact.keys()
    for name in known.keys() & exact.keys():
        assert known[name].specifier.contains(exact[name]), name


@pytest.mark.parametrize(
    ("name", "unsafe", "safe"), [("torch", "2.5.1", "2.6.0"), ("hydra-core", "1.3.5", "1.3.6")]
)
def test_versions_that_run_what_a_file_says_are_refused(name, unsafe, safe):
    """Older versions unpickle code by default, or call any function named in a logging configuration."""
    assert not requirements()[name].specifier.contains(unsafe)
    assert requirements()[name].specifier.contains(safe)
