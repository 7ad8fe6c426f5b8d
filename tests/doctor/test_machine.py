"""What the doctor says of a machine and of a configuration."""

import importlib.metadata

import torch

from ghgs_lit.cli import doctor_machine
from ghgs_lit.cli.doctor_machine import advice
from ghgs_lit.doctor.machine import machine_lines, missing_extras
from ghgs_lit.doctor.needs import Needs, needs
from ghgs_lit.model import GHGS
from tests.helpers.models import config
from tests.helpers.verbs import ghgs


def test_what_is_missing_is_named_with_the_command_that_installs_it(monkeypatch):
    """Extras that are there as a whole are not listed, nor what every installation has."""
    wanted = ['nothing-there>=1; extra == "magic"', 'torch>=2; extra == "magic"']
    wanted += ['numpy; extra == "there"', "absent-everywhere", 'absent-too; extra == "dev"']
    monkeypatch.setattr(importlib.metadata, "requires", lambda _: wanted)
    assert list(missing_extras()) == [("magic", "nothing-there missing: pip install 'ghgs-lit[magic]'")]


def test_the_machine_is_described():
    """Versions, processor, memory, GPU and renderer are there."""
    found = dict(machine_lines(torch.device("cpu")))
    assert f"torch {torch.__version__.split('+')[0]}" in found["versions"]
    assert {"processor", "threads", "memory", "renderer", "compiled kernels"} <= set(found)


def test_parameters_and_bytes_are_those_of_the_model():
    """The meta device gives what a built model has."""
    for trainable in ("all", "none"):
        described = config("model=hull", f"encoder.trainable={trainable}")
        found = {n.stage: n for n in needs(described)}
        model = GHGS.from_config(described)
        assert found["model"].parameters == sum(p.numel() for p in model.parameters())
        trained = sum(p.numel() for p in model.parameters() if p.requires_grad)
        assert found["model"].training == 4 * found["model"].parameters + 12 * trained
        assert found["encoder"].trained == (found["encoder"].parameters if trainable == "all" else 0)


def test_what_does_not_fit_is_said_with_the_key_that_helps():
    """Training takes four times the weights."""
    described = config("model=hull")
    large = Needs("model", 10**9, 10**9)
    said = "\n".join(advice(large, described, free=10 * 10**9))
    assert "prediction: 4.0 GB of 10.0 GB fits" in said
    assert "training: 16.0 GB of 10.0 GB does not fit" in said
    assert "encoder.trainable=none" in said
    assert "encoder.trainable" not in "\n".join(advice(large, described, free=20 * 10**9))


def test_the_verb_prints_machine_and_needs(tmp_path, capsys, monkeypatch):
    """An experiment is described without its data; brackets are no markup."""
    missing = [("magic", "x missing: pip install 'ghgs-lit[magic]'")]
    monkeypatch.setattr(doctor_machine, "missing_extras", lambda: missing)
    code = ghgs("doctor", "task=machine", "experiment=thuman2", "device=cpu", f"hydra.run.dir={tmp_path}")
    out = capsys.readouterr().out
    assert code == 0
    assert "This machine" in out
    assert "ghgs-lit[magic]" in out
    assert "recalibration" in out
    assert "before activations" in out
