"""Changes of a verb to its process do not reach the next test."""

import logging
import os

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import OmegaConf

from ghgs_lit.runs import job


def test_a_test_may_leave_what_a_verb_does(tmp_path):
    """Leave the changes that tests of sweeps and of training left."""
    os.environ |= {"HYDRA_FULL_ERROR": "1", "PL_GLOBAL_SEED": "1"}
    torch.set_float32_matmul_precision("high")
    assert not job.in_sweep()
    HydraConfig.instance().cfg = OmegaConf.create({"hydra": {"mode": RunMode.MULTIRUN}})
    assert job.in_sweep()
    logging.getLogger().addHandler(logging.FileHandler(tmp_path / "train.log", delay=True))
    logging.getLogger().setLevel(logging.INFO)


def test_the_next_test_does_not_find_it():
    """Regression: products were rounded, errors had tracebacks, logs went to files of another test, and
    whether a job was part of a sweep depended on the order of tests."""
    assert not job.in_sweep()
    assert not {"HYDRA_FULL_ERROR", "PL_GLOBAL_SEED"} & os.environ.keys()
    assert torch.get_float32_matmul_precision() == "highest"
    root = logging.getLogger()
    assert not [handler for handler in root.handlers if type(handler) is logging.FileHandler]
    assert root.level == logging.WARNING
