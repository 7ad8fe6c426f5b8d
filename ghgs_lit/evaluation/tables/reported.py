"""The figures that the paper prints in its tables (``reported.yaml``), and its names of data sets."""

import re
from functools import cache
from pathlib import Path
from typing import Any

from ghgs_lit.readers import read_yaml


@cache
def _content() -> dict[str, Any]:
    return read_yaml(Path(__file__).parent / "reported.yaml")


def data_title(name: str) -> str:
    """The paper's name of a data set, whatever its spelling (``zju_mocap``); ``name`` where it has none."""
    return _content()["data"].get(re.sub(r"[^a-z0-9]", "", name.lower()), name)


def reported_source() -> str:
    """The reference of the paper."""
    return _content()["source"]


def reported_table(name: str) -> tuple[str, dict[str, dict[int | str, dict[str, float]]]]:
    """The data of one of the paper's tables, and its rows: method -> views or data -> metric -> figure."""
    table, metrics = _content()["tables"][name], _content()["metrics"]
    rows = {
        method: {group: dict(zip(metrics, figures, strict=True)) for group, figures in groups.items()}
        for method, groups in table["rows"].items()
    }
    return table["data"], rows


def reported_data(name: str) -> list[str]:
    """The data sets that are columns of a reported table."""
    return list(dict.fromkeys(group for row in reported_table(name)[1].values() for group in row))
