"""Fixtures for sweeps that do not train."""

import pytest

from ghgs_lit.cli import train as train_verb
from tests.cli.test_main import call
from tests.helpers.jobs import record_execution, rehearse_nothing
from tests.helpers.verbs import refuse, succeed


@pytest.fixture
def plans_alone(monkeypatch):
    rehearse_nothing(monkeypatch)


@pytest.fixture
def sweep(monkeypatch, capsys, tmp_path):
    """``sweep("seed=1,2")`` runs ``ghgs train`` as a sweep in ``tmp_path / "sweep"`` without training."""
    monkeypatch.setattr(train_verb, "train", record_execution)

    def run(*overrides: str):
        return call(monkeypatch, capsys, "train", "-m", f"hydra.sweep.dir={tmp_path / 'sweep'}", *overrides)

    run.directory = tmp_path / "sweep"
    there = f"hydra.sweep.dir={run.directory}"
    run.succeed = lambda *overrides: succeed(capsys, "train", "-m", there, *overrides)
    run.refuse = lambda *overrides: refuse(capsys, "train", "-m", there, *overrides)
    return run


@pytest.fixture
def verb(monkeypatch, capsys):
    """``verb("seed=1")`` runs ``ghgs train`` without training."""
    monkeypatch.setattr(train_verb, "train", record_execution)

    def run(*overrides: str):
        return call(monkeypatch, capsys, "train", *overrides)

    run.refuse = lambda *overrides: refuse(capsys, "train", *overrides)
    return run
