"""Rows and budgets of a benchmark."""

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd

from ghgs_lit.diagnostics.benchmark.measure import TOTAL, Record
from ghgs_lit.runs.results import Row, summarize

#: Metrics besides PSNR in the row ``total`` of a case, if known.
ERRORS = (
    "psnr_box", "ssim", "ssim_box", "flip", "flip_box", "lpips", "psnr_box_40", "psnr_edge", "spill",
    "sharpness", "depth_error_mm",
)  # fmt: skip


def rows_of(records: Sequence[Record]) -> list[Row]:
    """Rows of the tables and of ``benchmark.json``: one for each case (the yardstick first) and stage; row
    ``total`` also has errors and budgets."""
    rows: list[Row] = []
    psnr_of_none = summarize(records[0].metrics)[0]["psnr"]
    for record in records:
        (means,) = summarize(record.metrics)
        costs = pd.DataFrame(record.costs)
        changes = pd.DataFrame(record.changes)
        worst = changes.max(skipna=False).to_dict() | {"psnr_to_none": changes.psnr_to_none.min()}
        total = {
            **costs.mean().to_dict(),
            "peak_bytes": float(costs.peak_bytes.max()),
            **{name: worst[name] for name in ("max_rel_diff", "rel_diff")},
            "psnr": means["psnr"],
            "psnr_loss_db": psnr_of_none - means["psnr"],
            "difference_db": difference_db(worst["mse_to_none"], psnr_of_none),
            "budget_db": record.case.budget_db,
            "max_rel_diff_budget": record.case.max_rel_diff,
            "trained": record.case.is_trained,
            **{name: means[name] for name in ERRORS if name in means},
            "differences": worst,
        }
        for stage, seconds in record.seconds.items():
            low, median, high = np.quantile(seconds, (0.25, 0.5, 0.75)).tolist()
            row = {"preset": record.case.label, "stage": stage, "seconds": median}
            row |= {"seconds_low": low, "seconds_high": high, "psnr": None}
            rows.append(row | total if stage == TOTAL else row)
    return rows


def difference_db(mse: float, psnr: float) -> float:
    """PSNR that renders lose by a difference that is independent of their error.

    Unlike the loss against the truth it cannot be 0 or negative by chance.

    Args:
        mse: mean squared difference of the renders, of images in [0, 1].
        psnr: of the renders without the difference, in dB.

    Returns:
        The loss in dB, at least 0.
    """
    return 10 * math.log10(1 + mse * 10 ** (psnr / 10))


def broken_budgets(row: Row) -> list[str]:
    """Why a row ``total`` breaks its budget, one line for each reason; none: it is kept. PSNR counts for
    trained weights only, differences for all."""
    lines = []
    loss = row["psnr_loss_db"]
    if (limit := row["max_rel_diff_budget"]) is not None:
        loss = max(loss, row["difference_db"])
        missing = row["differences"]["unmatched"]
        if not row["rel_diff"] <= limit:
            lines.append(f"expected rel_diff up to max_rel_diff={limit:g}; found {row['rel_diff']:g}")
        if missing > 0:
            lines.append(f"expected the Gaussians of none; found {missing:.2%} others")
    limit = row["budget_db"]
    if row["trained"] and limit is not None and not loss <= limit:
        lines.append(f"expected a loss up to {limit:g} dB of PSNR; found {loss:.3g}")
    return lines
