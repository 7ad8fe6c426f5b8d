"""The configuration is found in a wheel, in an editable install and in a checkout."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
FIND = "from ghgs_lit.config import conf_dir; print(conf_dir())"


def found_conf(cwd: Path, pythonpath: Path | None) -> Path:
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
    """A wheel without ``conf`` or the body model would fail on first use."""
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
    conf = found_conf(tmp_path, site)
    assert conf == (site / "ghgs_lit" / "conf").resolve()
    assert groups(conf) == groups(REPOSITORY / "conf")
    assert (site / "hydra_plugins" / "ghgs_lit_sweeper.py").is_file()
    assets = Path("ghgs_lit", "synthesis", "people", "assets")
    shipped, packed = (
        {p.name for p in (root / assets).iterdir() if p.is_file()} for root in (REPOSITORY, site)
    )
    assert shipped == packed


def test_editable_install(tmp_path):
    """Developers must get the checkout's ``conf``, not an installed copy."""
    assert found_conf(tmp_path, None) == REPOSITORY / "conf"


def test_checkout(tmp_path):
    """The package must run from a copy of the repository that is not installed."""
    for name in ("ghgs_lit", "conf"):
        shutil.copytree(REPOSITORY / name, tmp_path / "copy" / name)
    assert found_conf(tmp_path, tmp_path / "copy") == (tmp_path / "copy" / "conf").resolve()
