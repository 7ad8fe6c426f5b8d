"""What a check found: one row of the table."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

PASSED, FAILED, SKIPPED = "pass", "fail", "skip"


@dataclass(frozen=True)
class Outcome:
    """One row: what was checked, one of the three statuses, and what was found or why it was skipped."""

    check: str
    status: str
    found: str


def compared(check: str, found: Tensor, expected: Tensor, limit: float) -> Outcome:
    """Passes where :func:`relative_error` is at most ``limit``."""
    error = relative_error(found, expected)
    # Written so that NaN fails.
    return Outcome(check, PASSED if error <= limit else FAILED, f"error {error:.1e}, limit {limit:.0e}")


def relative_error(found: Tensor, expected: Tensor) -> float:
    """Norm of the difference as a share of that of ``expected``; NaN where shapes differ."""
    if found.shape != expected.shape:
        return float("nan")
    found, expected = found.detach().cpu().double(), expected.detach().cpu().double()
    norm = expected.norm()
    return float((found - expected).norm() / torch.where(norm > 0, norm, 1.0))


def table(outcomes: Sequence[Outcome]) -> str:
    """The outcomes as Markdown."""
    rows = [f"| {o.check} | {o.status} | {o.found.replace('|', '/')} |" for o in outcomes]
    return "\n".join(["| check | status | found |", "|---|---|---|", *rows])
