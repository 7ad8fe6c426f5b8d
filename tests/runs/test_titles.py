"""Titles of grid runs where runs are compared: the distinguishing overrides instead of the hash."""

from pathlib import Path

from omegaconf import OmegaConf

from ghgs_lit.config import run_of
from ghgs_lit.runs.plan import PlannedRun
from ghgs_lit.runs.run import RunDirectory
from ghgs_lit.runs.sweep import write_plan
from ghgs_lit.training.loggers import TensorBoardOptions

SHARED = ("experiment=demo", "data.root=a/b", "evaluation.views=[3,4]")


def plan_grid(folder, *grid: str, shared=SHARED) -> list[RunDirectory]:
    """Directories of a grid's runs, each given as ``ablation=full seed=1``, after its plan is written."""
    items = []
    for text in grid:
        shown, name = (*shared, *text.split()), f"{abs(hash((text, shared))):x}"[:12]
        items.append(PlannedRun(name, shown, shown, run_of("train"), RunDirectory(folder / name)))
    write_plan(items, OmegaConf.create(), folder)
    return [item.directory for item in items]


def test_runs_of_a_grid_have_the_names_of_what_differs(tmp_path):
    """TensorBoard files lie in folders of these names below the sweep's; seeds are always included."""
    runs = plan_grid(tmp_path, "ablation=full seed=1", "ablation=neither seed=1", "+optimizer.lr=0.1 seed=1")
    expected = ["ablation=full,seed=1", "ablation=neither,seed=1", "lr=0.1,seed=1"]
    assert [run.title for run in runs] == expected
    logs = [TensorBoardOptions().build(str(run.path)).log_dir for run in runs]
    assert [Path(folder) for folder in logs] == [tmp_path / "tb" / name for name in expected]


def test_a_run_keeps_its_name_when_the_grid_grows(tmp_path):
    """Also if the larger grid would add keys to it; other settings with the same title get their hash."""
    (first,) = plan_grid(tmp_path, "seed=1", shared=("ablation=full",))
    assert first.title == "ablation=full,seed=1"
    again, other = plan_grid(tmp_path, "seed=1", "seed=2", shared=("ablation=full",))
    assert (again.title, other.title) == (first.title, "seed=2")
    (twin,) = plan_grid(tmp_path, "seed=2 trainer=gpu", shared=())
    (third,) = plan_grid(tmp_path, "seed=2", shared=())
    assert twin.title == "seed=2,trainer=gpu"
    assert third.title == f"seed=2,run={third.path.name}"


def test_two_runs_of_one_title_keep_their_curves_apart(tmp_path):
    """A run with the same title from another command does not write into the files of the first."""
    runs = plan_grid(tmp_path, "seed=1", "seed=2", shared=())
    for run in runs:
        (run.path / "swept.json").write_text('["seed=1"]')
        with run.claim():
            run.begin(run_of("train"))
    first, second = (run.curves for run in runs)
    assert (first.name, second.name) == ("seed=1", f"seed=1,run={runs[1].marker.id}")
    assert [(folder / ".run").read_text() for folder in (first, second)] == [run.marker.id for run in runs]


def test_a_run_of_its_own_has_its_files_in_its_folder(tmp_path):
    logger = TensorBoardOptions().build(str(tmp_path / "mine"))
    assert Path(logger.log_dir) == tmp_path / "mine" / "tensorboard"
    assert RunDirectory(tmp_path / "mine").swept == []


def test_names_are_those_of_folders(tmp_path):
    """Titles of a value that is a path, and of a long one."""
    long = "x" * 300
    runs = plan_grid(tmp_path, "init_from=a/b.ckpt seed=1", f"init_from={long} seed=2", shared=())
    assert runs[0].title == "init_from=a_b.ckpt,seed=1"
    assert runs[1].title.endswith("x,seed=2")
    assert len(runs[1].title) == 200
