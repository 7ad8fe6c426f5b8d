"""All cells of tables as CSV, one for each line, with all digits."""

import csv
import io
from collections.abc import Sequence
from dataclasses import astuple
from typing import Any

from ghgs_lit.evaluation.tables.layouts import Cell, Column, Line, Table
from ghgs_lit.evaluation.tables.reported import data_title
from ghgs_lit.evaluation.tables.text import deviation

COLUMNS = (
    "table", "kind", "method", "model", "encoder", "ablation", "unprojection", "semantic", "extra", "data",
    "split", "targets", "protocol", "views", "metric", "mean", "deviation", "seeds", "seeds_lacking",
    "subjects", "best", "test_n", "test_difference", "test_p", "test_p_holm", "runs",
)  # fmt: skip


def _line(number: int, table: Table, line: Line, column: Column, cell: Cell | None) -> dict[str, Any]:
    group, metric = column
    variant, setting, reported = line.variant, table.records[0].setting, line.is_reported
    data = group.data or (table.reported_on if reported else data_title(setting.data))
    unprojection, semantic = variant.switches or ("", "")
    about = {
        "table": number,
        "kind": variant.kind,
        "method": line.stub[0] if table.layout.rows == "methods" else "ours",
        "model": variant.model,
        "encoder": variant.encoder,
        "ablation": variant.ablation,
        "unprojection": unprojection,
        "semantic": semantic,
        "extra": " ".join(f"{key}={value}" for key, value in variant.extra),
        "data": data,
        # Our names of splits, targets and protocols do not apply to the paper's figures.
        **{k: "" if reported else getattr(setting, k) for k in ("split", "targets", "protocol")},
        "views": group.views,
        "metric": metric,
    }
    if cell is None:
        return about
    about |= {
        "mean": cell.mean,
        "deviation": deviation(list(cell.seeds.values())),
        "seeds": "" if reported else " ".join(map(str, sorted(cell.seeds))),
        "seeds_lacking": " ".join(map(str, cell.missing_seeds)),
        "subjects": cell.count,
        "best": cell.best,
        "runs": " ".join(cell.runs),
    }
    if cell.test is not None:
        names = ("test_n", "test_difference", "test_p", "test_p_holm")
        about |= dict(zip(names, astuple(cell.test), strict=True))
    return about


def to_csv(tables: Sequence[Table]) -> str:
    """Means, deviations, tests and runs; the mean is empty where a run is missing."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, restval="", lineterminator="\n")
    writer.writeheader()
    for number, table in enumerate(tables, 1):
        for line in table.lines:
            for column in table.columns:
                writer.writerow(_line(number, table, line, column, line.cells.get(column)))
    return text.getvalue()
