"""The paper's four tables from one folder that holds the four sweeps, against expected files."""

import json
from pathlib import Path

import pytest

from ghgs_lit.config.keys import ABLATIONS
from scripts.miniatures import humman, thuman2, zju_mocap
from tests.helpers.captures import make_miniature
from tests.helpers.verbs import ghgs

EXPECTED = Path(__file__).parents[2] / "fixtures" / "paper_tables"
SWEEPS = ("table1", "table2", "table3", "table4")
VIT = "vit: {depth: 2, heads: 2}"
SMALL = (
    f"encoder={{width: 32, heads: 2, depth: 4, layers: [0, 1, 2, 3], image_size: 28, {VIT}}}",
    "data.size=28", "data.workers=0", "trainer=cpu", "trainer.max_steps=2", "logger=none", "callbacks=none",
    "recalibration.k=8", "recalibration.num_heads=2", "loss.weights.chamfer=0", "allow_random_encoder=true",
    "evaluation.pictures=0", "metrics.lpips=off", "seed=1",
)  # fmt: skip


def set_figures(path: Path) -> None:
    """Give a run figures that depend on its data, views and ablation alone, on any machine."""
    content = json.loads(path.read_text())
    source = content["provenance"]
    (views,) = source["config"]["views"]["training_counts"]
    rank = list(ABLATIONS.values()).index(source["ablation"])
    shift = {"zju_mocap": 0.3, "humman": 0.6, "thuman2": 0.0}[source["data"]["name"]]
    for row in content["rows"]:
        row["psnr"] = 20 + views + rank / 2 + shift
        row["ssim"] = 0.9 + views / 100 + rank / 1000
        row["flip"] = 0.1 - views / 100 - rank / 1000
        row["shared_neighbors"] = 0.5
    path.write_text(json.dumps(content))


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """The folder of the four sweeps on miniatures of the three data sets."""
    folder = tmp_path_factory.mktemp("paper")
    thuman2.make(folder / "thuman2", {"train": 1, "val": 1}, 64, 3)
    make_miniature(zju_mocap, folder / "zju_mocap", ["386", "377"], 64, 3, 1)
    make_miniature(humman, folder / "humman", ["p000455_a000986"], {"train": 1, "val": 1}, 64, 3, [0])
    common = (f"data.root={folder}/${{data.name}}", f"hydra.sweep.dir={folder / 'runs'}")
    for sweep in SWEEPS:
        assert ghgs("train", f"sweep={sweep}", *SMALL, *common) == 0
    for path in (folder / "runs").glob("*/metrics.json"):
        set_figures(path)
    return folder / "runs"


@pytest.mark.parametrize("layout", SWEEPS)
def test_each_layout_shows_its_runs_of_the_folder(runs, layout, tmp_path):
    """One row of ours in tables 1 to 3, each column by the model trained with so many views."""
    assert len(list(runs.glob("*/metrics.json"))) == 2 + 3 + 3
    assert ghgs("table", f"runs={runs}", f"layout={layout}", f"hydra.run.dir={tmp_path}") == 0
    assert (tmp_path / "table.md").read_text() == (EXPECTED / f"{layout}.md").read_text()
