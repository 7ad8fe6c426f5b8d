"""What the doctor says of a machine and of a configuration."""

import importlib.metadata

import torch

from ghgs_lit.cli import doctor_machine
from ghgs_lit.diagnostics.doctor.estimate import parameters
from ghgs_lit.diagnostics.doctor.machine import machine_lines, missing_extras
from ghgs_lit.model import GHGS
from tests.helpers.models import TINY, config
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


def test_parameters_are_those_of_the_model():
    """The meta device gives what a built model has."""
    for trainable in ("all", "none"):
        described = config("model=hull", f"encoder.trainable={trainable}")
        found = parameters(described)
        model = GHGS.from_config(described)
        total = sum(p.numel() for p in model.parameters())
        assert found["model"] == (total, sum(p.numel() for p in model.parameters() if p.requires_grad))
        assert found["encoder"][1] == (found["encoder"][0] if trainable == "all" else 0)


def test_the_verb_says_what_fits_and_which_keys_make_it_fit(tmp_path, capsys, monkeypatch):
    """A data set is described without its files; brackets are no markup."""
    missing = [("magic", "x missing: pip install 'ghgs-lit[magic]'")]
    monkeypatch.setattr(doctor_machine, "missing_extras", lambda: missing)
    trained, passes = doctor_machine.trained, []

    def sparing(config, kind):
        """What one key alone saves is tested with the estimate."""
        alone = passes and sum(config[name] != passes[0][0][name] for name in config) == 1
        passes.append((config, passes[0][1] if alone else trained(config, kind)))
        return passes[-1][1]

    monkeypatch.setattr(doctor_machine, "trained", sparing)
    code = ghgs(
        "doctor", "task=machine", *TINY, "data=thuman2", "data.size=56", "loss=depth", "device=cpu",
        "gpu_memory=0.006", f"hydra.run.dir={tmp_path}",
    )  # fmt: skip
    out = capsys.readouterr().out
    assert code == 0
    assert "This machine" in out
    assert "ghgs-lit[magic]" in out
    assert "4 views of 56 x 56, the subject on 15% of the frame" in out
    lines = {line.split(": ")[0].strip(): line for line in out.splitlines() if "fit" in line}
    assert lines["training step"].endswith("of 6.0 MB does not fit")
    assert {"prediction", "skip=fast", "encoder.checkpointing=true", "trainer.precision=bf16-mixed"} < set(
        lines
    )
    assert "all of them" in lines
