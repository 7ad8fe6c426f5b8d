"""The description of a machine by ``ghgs doctor``."""

import importlib.metadata

import torch

from ghgs_capture.verbs import doctor
from ghgs_lit.diagnostics.machine import machine_lines, missing_extras
from tests.helpers.verbs import ghgs


def test_what_is_missing_is_named_with_the_command_that_installs_it(monkeypatch):
    """Neither complete extras nor required packages are listed."""
    wanted = ['nothing-there>=1; extra == "magic"', 'torch>=2; extra == "magic"']
    wanted += ['numpy; extra == "there"', "absent-everywhere", 'absent-too; extra == "dev"']
    monkeypatch.setattr(importlib.metadata, "requires", lambda _: wanted)
    assert list(missing_extras()) == [("magic", "nothing-there missing: pip install 'ghgs-lit[magic]'")]


def test_a_package_that_is_not_installed_is_reported(monkeypatch):
    """If the package runs from its sources, its extras are not known."""

    def unknown(name: str):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "distribution", unknown)
    ((name, text),) = missing_extras()
    assert name == "ghgs-lit"
    assert "not installed" in text


def test_the_machine_is_described():
    """Versions, processor, memory, GPU and renderer are listed."""
    found = dict(machine_lines(torch.device("cpu")))
    assert f"torch {torch.__version__.split('+')[0]}" in found["versions"]
    assert "None" not in found.get("GPU", "")
    assert {"processor", "threads", "memory", "renderer", "compiled kernels"} <= set(found)


def test_the_command_prints_both(tmp_path, capsys, monkeypatch):
    """Brackets are printed, not interpreted as markup."""
    missing = [("magic", "x missing: pip install 'ghgs-lit[magic]'")]
    monkeypatch.setattr(doctor, "missing_extras", lambda: missing)
    assert ghgs("doctor", "task=machine", "device=cpu", f"hydra.run.dir={tmp_path}") == 0
    out = capsys.readouterr().out
    assert "This machine" in out
    assert "ghgs-lit[magic]" in out
