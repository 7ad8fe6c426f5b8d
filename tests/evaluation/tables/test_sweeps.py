"""Tables of trained sweeps: the paper's four from one folder, against expected files, and one with a
user-defined ablation."""

import csv
import json
from pathlib import Path

import pytest

from ghgs_lit.config.keys import ABLATIONS
from scripts.miniatures import humman, thuman2, zju_mocap
from tests.helpers.captures import make_miniature
from tests.helpers.models import TINY
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
    """Give a run figures that depend only on its data, views and ablation, on any machine."""
    content = json.loads(path.read_text())
    source = content["provenance"]
    source["git"] = None  # may change while this runs
    (views,) = source["config"]["views"]["training_counts"]
    rank = list(ABLATIONS.values()).index(source["ablation"])
    shift = {"zju_mocap": 0.3, "humman": 0.6, "thuman2": 0.0}[source["data"]["name"]]
    for row in content["rows"]:
        row["psnr"] = 20 + views + rank / 2 + shift
        row["ssim"] = 0.9 + views / 100 + rank / 1000
        row["lpips"] = 0.1 - views / 100 - rank / 1000
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
    """Tables 1 to 3 have one row of ours; each column is of the model trained with that number of views."""
    assert len(list(runs.glob("*/metrics.json"))) == 2 + 3 + 3
    assert ghgs("table", f"runs={runs}", f"layout={layout}", f"hydra.run.dir={tmp_path}") == 0
    for name in (f"{layout}.md", f"{layout}.tex"):
        assert (tmp_path / name.replace(layout, "table")).read_text() == (EXPECTED / name).read_text()


def test_an_ablation_of_ones_own_is_trained_evaluated_and_printed(tmp_path, boxes, monkeypatch, capsys):
    """From a YAML file outside the package to the row of its name."""
    monkeypatch.chdir(tmp_path)
    file = Path("conf/ablation/one_neighbor.yaml")
    file.parent.mkdir(parents=True)
    file.write_text("# @package _global_\nrecalibration: {k: 1}\n")
    common = ["--config-dir", "conf", "views=v3", "evaluation.targets=[midway]", "evaluation.pictures=0"]
    small = [override for override in TINY if not override.startswith("recalibration.k=")]
    data = ["data=scans", f"data.root={boxes}", "data.size=28"]
    quick = ["model=paper", "trainer.max_steps=2", "logger=none", "callbacks=none"]
    grid = ["-m", "ablation=full,one_neighbor", "hydra.sweep.dir=sweep"]
    assert ghgs("train", *common, *data, *small, *quick, *grid) == 0
    names = {}
    for path in Path("sweep").glob("*/metrics.json"):
        provenance = json.loads(path.read_text())["provenance"]
        assert provenance["ablation"] == provenance["config"]["chosen"]["ablation"]
        names[provenance["ablation"]] = path.parent
    assert set(names) == {"full", "one_neighbor"}
    # Measured again: the ablation is read from the checkpoint, not from the command.
    run = [f"checkpoint={names['one_neighbor']}/checkpoints/last.ckpt", "hydra.run.dir=measured"]
    assert ghgs("evaluate", *common, *run) == 0
    measured = json.loads(Path("measured/metrics.json").read_text())
    assert measured["provenance"]["ablation"] == "one_neighbor"
    psnr = [row["psnr"] for row in measured["rows"] if row["targets"] == "midway"]
    for runs in ("sweep", "[sweep,measured]"):
        options = [f"runs={runs}", "evaluation.views=[3]", "columns=[psnr]", "hydra.run.dir=table"]
        assert ghgs("table", *options) == 0
        rows = {
            row["ablation"]: row["mean"]
            for row in csv.DictReader(Path("table/table.csv").read_text().splitlines())
        }
        assert list(rows) == ["neither", "no_unprojection", "no_semantic", "full", "one_neighbor"]
        assert float(rows["one_neighbor"]) == pytest.approx(sum(psnr) / len(psnr), rel=1e-6)
        assert (rows["neither"] == "", rows["full"] == "") == (True, False)
        assert "differ also in `recalibration.k` (64, 1)" in Path("table/table.md").read_text()
    # The ablation of a checkpoint cannot be overridden.
    assert ghgs("evaluate", *common, *run, "ablation=full") == 1
    assert "ablation: expected one_neighbor, as the checkpoint was trained" in capsys.readouterr().err
