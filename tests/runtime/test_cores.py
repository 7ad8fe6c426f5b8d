"""CPU cores that a process may use."""

import os

import pytest

from ghgs_lit.runtime import cores


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({}, 6),
        ({"cpu.max": "max 100000"}, 6),
        ({"cpu.max": "250000 100000"}, 2),
        ({"cpu.max": "50000 100000"}, 1),
        ({"cpu/cpu.cfs_quota_us": "300000", "cpu/cpu.cfs_period_us": "100000"}, 3),
        ({"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, 6),
    ],
)
def test_affinity_and_quota_limit_the_cores(monkeypatch, tmp_path, files, expected):
    """On a machine with 64 cores, a job may use six, its container fewer."""
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(6)), raising=False)
    (tmp_path / "cpu").mkdir()
    for name, text in files.items():
        (tmp_path / name).write_text(text + "\n")
    assert cores.allowed_cores(tmp_path) == expected


def test_one_process_of_a_machine_spins_where_nothing_else_runs(monkeypatch, tmp_path):
    """Its children do not spin, nor do a second process and one of several."""
    monkeypatch.setattr(cores.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(cores, "_spins", [])
    monkeypatch.setattr(os, "environ", {})
    busy, idle = tmp_path / "busy", tmp_path / "idle"
    busy.write_text("0.20 0.18 0.12 3/80 11206")
    idle.write_text("0.20 0.18 0.12 1/80 11206")
    for arguments, running in ([], busy), (["hydra/launcher=joblib"], idle), ([], tmp_path / "none"):
        cores.spin_if_alone(arguments, running)
        assert os.environ == {}
    cores.spin_if_alone(["ghgs", "train", "-m", "hydra.sweep.dir=runs"], idle)
    assert os.environ.pop("GOMP_SPINCOUNT") == "20000"
    cores.spin_if_alone(["ghgs", "train"], idle)
    assert os.environ == {}
    os.environ["GOMP_SPINCOUNT"] = "20000"
    cores.let_children_sleep()
    assert os.environ == {}
