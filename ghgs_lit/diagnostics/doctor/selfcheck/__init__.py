"""Whether a device computes as the CPU does in float64: one file for each kind of check."""

from ghgs_lit.diagnostics.doctor.selfcheck.outcome import FAILED, PASSED, SKIPPED, Outcome, table
from ghgs_lit.diagnostics.doctor.selfcheck.run import selfcheck

__all__ = ["FAILED", "PASSED", "SKIPPED", "Outcome", "selfcheck", "table"]
