"""The paper's tables from directories of runs."""

from ghgs_lit.evaluation.tables.build import build_tables
from ghgs_lit.evaluation.tables.layouts import LAYOUTS
from ghgs_lit.evaluation.tables.runs import read_sweep
from ghgs_lit.evaluation.tables.writers import PREAMBLE, to_csv, to_latex, to_markdown

__all__ = ["LAYOUTS", "PREAMBLE", "build_tables", "read_sweep", "to_csv", "to_latex", "to_markdown"]
