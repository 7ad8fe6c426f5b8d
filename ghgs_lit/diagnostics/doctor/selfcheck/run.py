"""All checks in their order."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch

from ghgs_lit.diagnostics.doctor.selfcheck.model import gradient, stages
from ghgs_lit.diagnostics.doctor.selfcheck.outcome import FAILED, Outcome
from ghgs_lit.diagnostics.doctor.selfcheck.processes import two_processes
from ghgs_lit.diagnostics.doctor.selfcheck.renderer import renderer
from ghgs_lit.diagnostics.doctor.selfcheck.work import work

#: Characters of an error that are shown.
_LONGEST = 300

Check = Callable[[Mapping[str, Any], torch.device], Iterator[Outcome]]
CHECKS: dict[str, Check] = {
    "renderer": renderer,
    "model": stages,
    "gradient": gradient,
    "two processes": two_processes,
    "work": work,
}


def selfcheck(config: Mapping[str, Any], device: torch.device) -> Iterator[Outcome]:
    """All checks, each outcome as soon as it is known.

    An error ends its check, not the others: it is an outcome.

    Args:
        config: of a run of ``ghgs train``; its model gets random weights.
        device: what is compared with the CPU.
    """
    for name, check in CHECKS.items():
        try:
            yield from check(config, device)
        except Exception as error:
            text = " ".join(f"{type(error).__name__}: {error}".split())
            yield Outcome(name, FAILED, text[:_LONGEST])
