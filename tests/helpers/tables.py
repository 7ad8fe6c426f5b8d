"""Invented runs for tests of tables."""

from pathlib import Path

import yaml

from ghgs_lit.config.keys import ABLATIONS
from ghgs_lit.evaluation import tables as t
from ghgs_lit.runs.results import config_hash, write_results

SWITCHES = {name: switches for switches, name in ABLATIONS.items()}
SHIFTS = {"a": -1.0, "b": 1.0}


def config_of(row, seed=1, data="synthetic", **changes) -> dict:
    unprojection, semantic = SWITCHES[row]
    return {
        "recalibration": {
            "neighborhood": "xyz" if unprojection else "image_plane",
            "similarity": "product" if semantic else "none",
        },
        "model": {"name": "paper"},
        "encoder": {"weights": None},
        "data": {"name": data},
        "trainer": {"max_steps": 10},
        "seed": seed,
        **changes,
    }


def write_run(
    folder: Path, row, psnr, seed=1, views=(3, 4, 5), targets="release", shifts=SHIFTS, data="synthetic",
    protocol="correct", method="model", measured=None, metrics=None, provenance=None, **config,
) -> Path:  # fmt: skip
    """Write a run whose mean PSNR at n views is ``psnr + n``; each subject differs from it by its shift.

    Args:
        folder: Of the run.
        row: Its ablation.
        psnr: None: the run has no results yet.
        measured: Further configuration of `ghgs evaluate`; None: results of a training.
        metrics: Further metrics of each row of results.
        provenance: Further provenance.
        config: Changes of the training's configuration; ``of_`` precedes ``views``, ``targets`` and ``data``.
    """
    if psnr is None:
        config = {"evaluation": {"views": [3, 4, 5]}, **config}
    config = config_of(row, seed, data, **{key.removeprefix("of_"): value for key, value in config.items()})
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    if psnr is None:
        return folder
    rows = []
    for n in views:
        about = {"method": method, "views": n, "targets": targets, "target": "000/3", "inputs": ["000/0"]}
        for subject, shift in shifts.items():
            values = {"psnr": psnr + n + shift, "ssim": 0.9, "flip": 0.1, **(metrics or {})}
            rows.append({**about, "subject": subject, **values})
    source = {
        "config": config,
        "seed": seed,
        "data": {"name": data, "split": "val"},
        "protocol": {"metrics": protocol},
        **(provenance or {}),
    }
    if measured is not None:
        evaluation = {**config_of("neither", 99), "data": {"name": data}, **measured}
        source |= {"checkpoint_config": config, "config": evaluation}
    source["config_hash"] = config_hash(source["config"])
    return write_results(folder, rows, source)


def tables_of(folder: Path, layout="ablation", by=(), **options):
    """Build the tables of the runs below a folder."""
    return t.build_tables(t.read_sweep([folder], by), t.LAYOUTS[layout], **options)
