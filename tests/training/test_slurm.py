"""Jobs of SLURM."""

import pytest

from ghgs_lit.cli.train import build_trainer
from ghgs_lit.config import compose, resolve
from ghgs_lit.errors import InputError

BATCH = {
    "SLURM_JOB_ID": "1234",
    "SLURM_JOB_NAME": "train",
    "SLURM_NNODES": "1",
    "SLURM_NODEID": "0",
    "SLURM_JOB_NODELIST": "localhost",
    "SLURM_NTASKS": "4",
    "SLURM_PROCID": "0",
    "SLURM_LOCALID": "0",
}


def test_tasks_of_a_batch_script_are_no_processes(monkeypatch, tmp_path):
    """``#SBATCH --ntasks=4`` asks for cores; only ``srun`` starts as many processes."""
    config = resolve(compose("train", ["trainer=cpu", "logger=none", "callbacks=none"]))
    for name, value in BATCH.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("SLURM_STEP_ID", raising=False)
    monkeypatch.delenv("SRUN_DEBUG", raising=False)
    assert build_trainer(config, tmp_path).world_size == 1
    monkeypatch.setenv("SLURM_STEP_ID", "0")
    with pytest.raises(InputError, match=r"trainer: .*--ntasks-per-node=4"):
        build_trainer(config, tmp_path)
