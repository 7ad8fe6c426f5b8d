"""All cells of tables as CSV, one a line, in full."""

import csv
import io
from collections.abc import Sequence
from typing import Any

from ghgs_lit.tables.layouts import Cell, Column, Line, Table
from ghgs_lit.tables.others import data_title
from ghgs_lit.tables.records import ABLATIONS
from ghgs_lit.tables.text import deviation

COLUMNS = (
    "table", "kind", "method", "model", "encoder", "ablation", "unprojection", "semantic", "extra", "data",
    "split", "targets", "protocol", "views", "metric", "mean", "deviation", "seeds", "seeds_lacking",
    "subjects", "best", "test_n", "test_difference", "test_p", "test_p_holm", "runs",
)  # fmt: skip


def _line(number: int, table: Table, line: Line, column: Column, cell: Cell | None) -> dict[str, Any]:
    group, metric = column
    variant, setting = line.variant, table.about["records"][0].setting
    reported = variant.kind == "reported"
    data = group.data or (table.reported_on if reported else data_title(setting.data))
    about = {
        "table": number,
        "kind": variant.kind,
        "method": line.stub[0] if table.layout.rows == "methods" else "ours",
        "model": variant.model,
        "encoder": variant.encoder,
        "ablation": ABLATIONS[variant.switches] if variant.switches else "",
        "unprojection": variant.switches[0] if variant.switches else "",
        "semantic": variant.switches[1] if variant.switches else "",
        "extra": " ".join(f"{key}={value}" for key, value in variant.extra),
        "data": data,
        # What the paper's figures were measured on is the paper's to say.
        **{k: "" if reported else getattr(setting, k) for k in ("split", "targets", "protocol")},
        "views": group.views,
        "metric": metric,
    }
    if cell is None:
        return about
    test = cell.test
    return about | {
        "mean": cell.mean,
        "deviation": deviation(list(cell.seeds.values())),
        "seeds": "" if reported else " ".join(map(str, sorted(cell.seeds))),
        "seeds_lacking": " ".join(map(str, cell.lacking)),
        "subjects": cell.count,
        "best": cell.best,
        "test_n": test and test.n,
        "test_difference": test and test.difference,
        "test_p": test and test.p,
        "test_p_holm": test and test.corrected,
        "runs": " ".join(cell.runs),
    }


def to_csv(tables: Sequence[Table]) -> str:
    """Means, deviations, tests and the runs behind them; the mean is empty where a run is missing."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, restval="", lineterminator="\n")
    writer.writeheader()
    for number, table in enumerate(tables, 1):
        for line in table.lines:
            for column in table.columns:
                writer.writerow(_line(number, table, line, column, line.cells.get(column)))
    return text.getvalue()
