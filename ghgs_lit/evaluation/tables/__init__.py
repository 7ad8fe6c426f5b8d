"""The paper's tables from directories of runs."""

from ghgs_lit.config.nodes import PairedTest
from ghgs_lit.evaluation.tables.build import build_tables
from ghgs_lit.evaluation.tables.layouts import LAYOUTS, Table, TableOptions
from ghgs_lit.evaluation.tables.others import read_others
from ghgs_lit.evaluation.tables.runs import read_sweep
from ghgs_lit.evaluation.tables.writers import PREAMBLE, to_csv, to_latex, to_markdown, to_terminal

__all__ = [
    "LAYOUTS", "PREAMBLE", "PairedTest", "Table", "TableOptions", "build_tables", "read_others", "read_sweep",
    "to_csv", "to_latex", "to_markdown", "to_terminal",
]  # fmt: skip
