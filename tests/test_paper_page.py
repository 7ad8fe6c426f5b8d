"""The page about `model=paper` shows the values of the code."""

from pathlib import Path

from ghgs_lit.config import run_of
from ghgs_lit.method.bounds.box import MARGIN
from ghgs_lit.method.heads.attributes import OPACITY_START, SCALE_CAP


def test_the_page_prints_the_figures_of_the_code():
    text = (Path(__file__).parents[1] / "docs" / "method.md").read_text()
    run = run_of("train", ["experiment=thuman2", "data.root=x"]).plain
    head, recalibration, optimizer = run["gaussian_head"], run["recalibration"], run["optimizer"]
    attributes = head["attributes"]
    figures = [
        f"at most {100 * head['offset_limit']:g} cm",
        f"{attributes['scale_floor']} to {SCALE_CAP:g} footprints",
        f"at first {attributes['scale_start']} ",
        f"at least {attributes['opacity_floor']}, at first {OPACITY_START} ",
        f"{recalibration['k']} (`recalibration.k`)",
        f"{recalibration['num_heads']} heads",
        f"layers {', '.join(map(str, run['encoder']['layers']))} ",
        f"(`bounds.kind={run['bounds']['kind']}`, margin {100 * MARGIN:g} cm)",
        f"`encoder.trainable={run['encoder']['trainable']}`",
        f"`recalibration.tokens={recalibration['tokens']}`",
        f"weight decay {optimizer['weight_decay']:.0e}".replace("e-0", "e-"),
        f"{run['data']['size']} x {run['data']['size']} (HuMMan 360 x 640)",
    ]
    assert [figure for figure in figures if figure not in text] == []
