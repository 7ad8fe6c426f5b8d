"""List of the runs below folders: their overrides, state and best result."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from ghgs_lit.errors import InputError
from ghgs_lit.readers import read_rows, read_yaml
from ghgs_lit.runs.run import RunDirectory, State


def files_below(folders: Sequence[Path], name: str) -> list[Path]:
    """Files called ``name`` below folders, except in ``.hydra``. FileNotFoundError: a folder is missing."""
    for folder in folders:
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: expected a directory of runs; found none")
    paths = [path for folder in folders for path in sorted(folder.rglob(name))]
    return [path for path in paths if path.parent.name != ".hydra"]


def list_runs(folders: Sequence[Path]) -> pd.DataFrame:
    """A line for each training and each evaluation: ``run``, ``state``, ``best`` and ``overrides``. ``best``:
    highest mean PSNR over methods, numbers of views and target protocols, or over validations of a run
    without results. FileNotFoundError: a folder is missing. InputError: there is no run below them."""
    runs = []
    for path in files_below(folders, "config.yaml"):
        run, file = RunDirectory(path.parent), path.parent / ".hydra" / "overrides.yaml"
        if run.state != State.MISSING or _trains(path):
            said = read_yaml(file) if file.is_file() else []
            overrides = " ".join(map(str, said)) if isinstance(said, list) else ""
            runs.append((str(path.parent), str(run.state), _best(run), overrides))
    if not runs:
        raise InputError(f"{', '.join(map(str, folders))}: expected runs below it; found none")
    return pd.DataFrame(runs, columns=["run", "state", "best", "overrides"])


def _trains(path: Path) -> bool:
    try:
        return "trainer" in read_yaml(path)
    except (InputError, TypeError):
        return False


def _best(run: RunDirectory) -> str:
    if (results := run.results) is not None:
        rows = [row for row in results["summary"] if row.get("psnr") is not None]
        best = max(rows, key=lambda row: row["psnr"], default=None)
        return best and f"{best['psnr']:.2f} dB ({best['method']}, {best['views']} views, {best['targets']})"
    log = run.path / "csv" / "metrics.csv"
    rows = read_rows(log) if log.is_file() else []
    scores = pd.to_numeric(pd.Series([row.get("val/psnr") for row in rows], dtype=object), errors="coerce")
    return "" if scores.isna().all() else f"{scores.max():.2f} dB (validation)"
