"""Results of other methods, from JSON files in the format that ``docs/tables.md`` describes."""

from pathlib import Path
from typing import Annotated, Literal

import pandas as pd
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.tables.runs import SETTING
from ghgs_lit.evaluation.tables.variants import Variant
from ghgs_lit.parsing import read_json
from ghgs_lit.runs.results import validate

_Text = Annotated[str, Field(min_length=1)]
_Count = Annotated[int, Field(ge=1)]


class _Exact(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid")


class _Row(_Exact):
    data: _Text
    split: _Text
    targets: _Text
    protocol: _Text
    views: _Count
    seed: int = 0
    subject: _Text | None = None
    subjects: _Count | None = None
    metrics: Annotated[dict[str, FiniteFloat], Field(min_length=1)]


class _Others(_Exact):
    """A results file of another method."""

    format: Literal["ghgs_lit.others"]
    format_version: Literal[1]
    method: _Text
    source: _Text
    rows: Annotated[list[_Row], Field(min_length=1)]


def read_others(path: Path) -> pd.DataFrame:
    """Read the results file of another method.

    Args:
        path: JSON file in the format of ``docs/tables.md``.

    Returns:
        Rows as in :class:`ghgs_lit.evaluation.tables.runs.Sweep`. ``origin`` is the file's
        ``source``. Means have no ``subject``, and optionally a ``count`` of subjects.

    Raises:
        FileNotFoundError: There is no such file.
        InputError: It does not have the format; the message names the key.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected another method's results; found no such file")
    others = validate(_Others, read_json(path), path.name)
    rows = pd.DataFrame([row.model_dump() for row in others.rows])
    cell = [*SETTING, "views", "seed"]
    repeated = rows.duplicated([*cell, "subject"])
    if repeated.any():
        at = f"{path.name}.rows[{repeated.idxmax()}]"
        raise InputError(f"{at}: expected each subject once a setting; found one again")
    means = rows["subject"].isna()
    if (means.groupby([rows[key] for key in cell]).nunique() > 1).any() or rows[~means]["subjects"].any():
        raise InputError(f"{path.name}: expected subjects or one mean for each setting; found both")
    metrics = pd.DataFrame(list(rows.pop("metrics")), dtype=float)
    rows = rows.rename(columns={"subjects": "count"}).astype({"count": float})
    variant = Variant("other", others.method)
    return rows.assign(variant=variant, source=str(path), run=None, origin=others.source).join(metrics)
