"""The description of a machine by ``ghgs doctor``."""

import torch

from tests.helpers.verbs import ghgs


def test_the_machine_is_described(tmp_path, capsys):
    """Versions, processor, memory, GPU and renderer are listed."""
    assert ghgs("doctor", "task=machine", "device=cpu", f"hydra.run.dir={tmp_path}") == 0
    lines = capsys.readouterr().out.splitlines()
    found = {line[:18].strip(): line[18:] for line in lines}
    assert f"torch {torch.__version__.split('+')[0]}" in found["versions"]
    assert "None" not in found.get("GPU", "")
    assert {"processor", "threads", "memory", "renderer", "compiled kernels"} <= set(found)
