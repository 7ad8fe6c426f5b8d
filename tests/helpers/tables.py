"""Invented runs for the tests of tables."""

from pathlib import Path

import yaml

from ghgs_lit.evaluation import tables as t
from ghgs_lit.runs.provenance import config_hash
from ghgs_lit.runs.results import write_results

SWITCHES = {
    "full": (True, True),
    "no_unprojection": (False, True),
    "no_semantic": (True, False),
    "neither": (False, False),
}
SHIFTS = {"a": -1.0, "b": 1.0}


def config_of(row, seed=1, data="synthetic", weights=None, **changes) -> dict:
    unprojection, semantic = SWITCHES[row]
    return {
        "recalibration": {
            "neighborhood": "xyz" if unprojection else "image_plane",
            "similarity": "product" if semantic else "none",
        },
        "model": {"name": "paper"},
        "encoder": {"weights": weights},
        "data": {"name": data},
        "trainer": {"max_steps": 10},
        "seed": seed,
        **changes,
    }


def write_run(
    folder: Path, row, psnr, seed=1, views=(3, 4, 5), targets="release", lpips=None, weights=None,
    shifts=SHIFTS, data="synthetic", protocol="correct", method="model", git=None, verb="train",
    training=None, measured=None, nodes=None, **changes,
):  # fmt: skip
    """A run whose mean PSNR at n views is ``psnr + n``; each subject differs from it by its shift.
    ``nodes`` of its configuration are those whose names are arguments here, such as ``views``."""
    config = config_of(row, seed, data, weights, **changes, **(nodes or {}))
    rows = [
        {
            "method": method, "subject": subject, "views": n, "targets": targets, "target": "000/3",
            "inputs": ["000/0"], "psnr": psnr + n + shift, "ssim": 0.9, "flip": 0.1,
            **({} if lpips is None else {"lpips": lpips}),
        }
        for n in views
        for subject, shift in shifts.items()
    ]  # fmt: skip
    source = {
        "config": config,
        "seed": seed,
        "data": {"name": data, "split": "val"},
        "protocol": {"metrics": protocol},
        "git": git,
        "training": training,
    }
    if verb == "evaluate":
        source["checkpoint_config"] = config
        source["config"] = {**config_of("neither", 99), "data": {"name": data}, **(measured or {})}
    source["config_hash"] = config_hash(source["config"])
    path = write_results(folder, rows, source)
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    return path


def start_run(folder: Path, ablation, seed=1, **changes) -> None:
    """A run without results yet."""
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(config_of(ablation, seed, **changes)))


def tables_of(folder: Path, layout="ablation", by=(), others=(), **options):
    """The tables of the runs below a folder."""
    test = t.PairedTest(**options.pop("test", {}))
    chosen = t.TableOptions(t.LAYOUTS[layout], test=test, **options)
    return t.build_tables(t.read_sweep([folder], by), others, chosen)


def body(markdown: str):
    """The rows of a Markdown table by their first cells, without marks of notes, and its header."""
    lines = [
        [c.strip() for c in line.strip("|").split("|")] for line in markdown.splitlines() if line[:1] == "|"
    ]
    two = lines[0][0] == "3D Unproj."
    return {(row[0], row[1][:1]) if two else row[0]: row[2 if two else 1 :] for row in lines[2:]}, lines[0]
