"""The numbers in TensorBoard: one run for each preset, and the figure."""

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ghgs_lit.diagnostics.benchmark.report import totals
from ghgs_lit.runs.results import Row
from ghgs_lit.training.loggers import TensorBoardLog, Value

#: Numbers of a whole case that the HParams tab compares.
_COMPARED = ("seconds", "peak_bytes", "flops", "gaussians", "max_rel_diff", "psnr", "psnr_loss_db")


def write_board(
    directory: Path, rows: Sequence[Row], picture: bytes, hyperparameters: Mapping[str, Value]
) -> None:
    """Write ``directory/tensorboard``: scalars by stage, HParams and the figure.

    Args:
        directory: of the run.
        rows: of presets or of a scaling study, whose scalars have the axis' value as their step (shares in
            percent).
        picture: the figure as PNG.
        hyperparameters: of the run; each preset adds its name.
    """
    for preset in dict.fromkeys(row["preset"] for row in rows):
        own = [row for row in rows if row["preset"] == preset]
        name = re.sub(r"[^\w.=-]+", "_", preset)
        log = TensorBoardLog(str(directory / "tensorboard"), name=name, version="")
        log.log_hyperparams({**hyperparameters, "preset": preset})
        for row in own:
            axis, value = row.get("axis"), row.get("value", 0)
            tag = f"seconds/{row['stage']}" if axis is None else f"{axis}/{row['stage']}"
            log.log_metrics({tag: row["seconds"]}, round(100 * value) if axis == "share" else value)
        compared = totals(own)[0] if "axis" not in own[0] else {}
        results = {f"hparam/{n}": float(compared[n]) for n in _COMPARED if compared.get(n) is not None}
        log.log_results(results, 0)
        log.finalize("success")
    log = TensorBoardLog(str(directory / "tensorboard"), name="figure", version="")
    figure = np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"))
    log.experiment.add_image("benchmark", figure, 0, dataformats="HWC")
    log.finalize("success")
