"""Hydra's launchers and sweepers from extras, in sweeps without training."""

import os
from pathlib import Path

import pytest
from hydra.core.global_hydra import GlobalHydra

from ghgs_lit.errors import InputError
from ghgs_lit.runs.run import RunDirectory
from tests.helpers.jobs import executed, hydra_app

SETTINGS = {
    "joblib": ("hydra_plugins.hydra_joblib_launcher", "cluster", ["hydra.launcher.n_jobs=2"]),
    "submitit_local": (
        "hydra_plugins.hydra_submitit_launcher",
        "cluster",
        ["hydra.launcher.cpus_per_task=1", "hydra.launcher.timeout_min=5"],
    ),
}


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    # Jobs in other processes import the test doubles in tests/helpers.
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    GlobalHydra.instance().clear()


@pytest.mark.parametrize("launcher", sorted(SETTINGS))
def test_launchers_run_a_sweep_once(launcher, monkeypatch, capsys, tmp_path):
    """Jobs in other processes find resolvers and locks and can start data workers; a second call runs
    nothing."""
    module, extra, settings = SETTINGS[launcher]
    pytest.importorskip(module, reason=f"the extra {extra} is not installed", exc_type=ImportError)
    chosen = ["-m", f"hydra/launcher={launcher}", *settings, f"hydra.sweep.dir={tmp_path}", "data.workers=1"]
    # Each job of submitit is a process with its own imports.
    grid = ["seed=1,2"] if launcher == "submitit_local" else ["seed=1,2", "ablation=full,neither"]
    count = 2 ** len(grid)
    hydra_app(monkeypatch, *chosen, *grid)
    names = executed(tmp_path)
    assert len(names) == len(set(names)) == count
    assert all(RunDirectory(tmp_path / name).state == "done" for name in names)
    assert f"{count} runs: {count} done" in capsys.readouterr().out
    hydra_app(monkeypatch, *chosen, *grid)
    assert len(executed(tmp_path)) == count


# Fakes of the programs that submitit calls; jobs run immediately on this machine.
FAKES = {
    "sbatch": """#!/bin/bash
export SLURM_ARRAY_JOB_ID=7 SLURM_NTASKS=1 SLURM_PROCID=0 SLURM_LOCALID=0 SLURM_NODEID=0
export SLURM_JOB_NUM_NODES=1 SLURM_JOB_NODELIST=here
for i in 0 1; do SLURM_JOB_ID=$((7 + i)) SLURM_ARRAY_TASK_ID=$i bash "$1" > /dev/null 2>&1 & done
echo "Submitted batch job 7"
""",
    "srun": """#!/bin/bash
while [[ "$1" == -* ]]; do if [[ "$1" == --output || "$1" == --error ]]; then shift; fi; shift; done
exec "$@"
""",
    "sacct": "#!/bin/bash\necho 'JobID|State'\nfor i in 0 1; do echo \"7_$i|RUNNING\"; done\n",
}


@pytest.fixture
def slurm(monkeypatch, tmp_path):
    """``slurm(sbatch=...)`` puts :data:`FAKES` on the path, some with another script."""
    pytest.importorskip(
        "hydra_plugins.hydra_submitit_launcher",
        reason="the extra cluster is not installed",
        exc_type=ImportError,
    )
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    (tmp_path / "bin").mkdir()

    def replace(**texts: str) -> None:
        for name, text in (FAKES | texts).items():
            (tmp_path / "bin" / name).write_text(text)
            (tmp_path / "bin" / name).chmod(0o755)

    return replace


def test_what_sbatch_refuses_is_one_line(slurm, monkeypatch, tmp_path):
    """Regression: it was a traceback."""
    slurm(sbatch="#!/bin/bash\necho 'sbatch: error: invalid partition specified: nope' >&2\nexit 1\n")
    settings = [
        "hydra/launcher=slurm",
        "+hydra.launcher.partition=nope",
        f"hydra.sweep.dir={tmp_path / 'sweep'}",
    ]
    with pytest.raises(
        InputError, match=r"^hydra\.launcher: expected .*; found .*partition specified: nope$"
    ):
        hydra_app(monkeypatch, "-m", *settings, "seed=1,2")


def test_the_slurm_example_submits_what_is_missing(slurm, monkeypatch, tmp_path):
    """The shipped example submits valid jobs, each run once."""
    slurm()
    sweep = tmp_path / "sweep"
    hydra_app(monkeypatch, "-m", "hydra/launcher=slurm", f"hydra.sweep.dir={sweep}", "seed=1,2")
    names = executed(sweep)
    assert len(names) == len(set(names)) == 2
    (script,) = sweep.glob(".submitit/*/*.sh")
    assert "#SBATCH --gpus-per-node=1" in script.read_text()
