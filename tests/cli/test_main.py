"""The command line: verbs, one-line errors and exit codes."""

import re
import subprocess
import sys

import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from ghgs_lit.cli.application import parse_arguments
from ghgs_lit.cli.runtime import write_config
from ghgs_lit.cli.verbs import Train
from ghgs_lit.config import compose, run_of
from ghgs_lit.config.registry import verb_class, verbs
from tests.helpers.processes import run_python
from tests.helpers.verbs import ghgs, refuse, succeed


def call(monkeypatch, capsys, *argv: str) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of ``ghgs <argv>``."""
    GlobalHydra.instance().clear()
    code = ghgs(*argv)
    return code or 0, *capsys.readouterr()


def test_help_shows_an_example_for_every_verb_and_only_built_verbs(monkeypatch, capsys):
    """A verb without a module or configuration would fail only in use; example checkpoints have the paths
    that training writes."""
    out = succeed(capsys, "--help")
    for verb in verbs():
        assert verb_class(verb).example in out
    checkpoints = re.findall(r"checkpoint=(\S+)", out)
    assert checkpoints
    assert all(path.endswith("checkpoints/last.ckpt") for path in checkpoints)


def test_an_error_inside_a_verb_keeps_its_traceback(monkeypatch, capsys, tmp_path):
    """Only bad input is reported on one line; a bug must not look like it."""

    def run(self, *_):
        raise KeyError("bug")

    monkeypatch.setattr(Train, "run", run)
    with pytest.raises(KeyError, match="bug"):
        call(monkeypatch, capsys, "train", f"hydra.run.dir={tmp_path}")


def test_help_of_a_verb_and_of_a_group(monkeypatch, capsys, tmp_path):
    """Groups with their default, keys with meaning and range, including options of the user's folder."""
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "my_people.yaml").write_text("kind: scans\n")
    flags = ("model=paper", "--config-dir", str(tmp_path))
    out = succeed(capsys, "train", *flags, "--help")
    assert "the paper's model, or model=hull" in out
    assert "ablation: full*" in out
    assert "encoder: vggt_1b | vggt_nano* | vggt_small" in out
    assert "my_people | " in out
    assert "seed (default 1; an integer >= 0 and <= 4294967295)\n    Seed of the weights" in out
    out = succeed(capsys, "train", "model=hull", "--help", "depth_head")
    assert "== depth_head: {kind: dpt, ...} ==" in out
    assert "start (default 0.25; a number > 0 and < 1)" in out  # of depth_head=hull
    _, out, _ = call(monkeypatch, capsys, "train", "model=paper", "encoder.width=48", "--help", "encoder")
    assert "width (default 48; " in out
    _, out, _ = call(monkeypatch, capsys, "train", "--help", "ablation")
    assert "== ablation=neither ==" in out
    assert "similarity: none" in out
    err = refuse(capsys, "train", "--help", "depth_heat")
    assert "found 'depth_heat' (did you mean depth_head?)" in err


@pytest.mark.parametrize("verb", verbs())
def test_help_of_every_verb_names_its_keys(monkeypatch, capsys, verb):
    out = succeed(capsys, verb, "--help")
    for name in verb_class(verb).model_fields:
        assert re.search(rf"^ *{name}( |\.|:|$)", out, re.MULTILINE), name


def test_a_reader_that_closes_the_pipe_gets_no_traceback():
    command = [sys.executable, "-m", "ghgs_lit", "prepare", "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, bufsize=0) as process:
        process.stdout.close()
        assert (process.stderr.read(), process.wait()) == (b"", 141)


@pytest.mark.parametrize("arguments", ["--version", "prepare --cfg job"])
def test_closed_output_is_no_error(arguments):
    """Schedulers and daemons close standard output."""
    command = f"{sys.executable} -m ghgs_lit {arguments} >&-"
    done = subprocess.run(command, shell=True, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_prediction_goes_where_out_says():
    """Without ``out``, a prediction has a new folder."""
    for overrides, expected in ((["out=/a b/c"], "/a b/c"), ([], "runs/predict/")):
        directory = compose("predict", overrides, with_hydra=True).hydra.run.dir
        assert directory.startswith(expected)


def test_a_prediction_does_not_wait_for_what_training_needs():
    """Importing Lightning, torchmetrics and PyTorch's compiler takes seconds."""
    imports = "import sys, ghgs_capture.verbs.predict, ghgs_lit"
    code = f"{imports}; ghgs_lit.Predictor.from_checkpoint(); print(*sys.modules)"
    loaded = set(run_python(code).stdout.split())
    assert {"torch", "ghgs_lit.refinement"} <= loaded
    assert not {"lightning", "torchmetrics", "torch._dynamo", "trimesh", "matplotlib.pyplot"} & loaded


def test_a_verb_prints_the_path_of_its_configuration(monkeypatch, capsys, tmp_path):
    """A sweep must not print thousands of lines of configuration, which its files contain."""
    monkeypatch.setattr(HydraConfig.instance(), "cfg", None)
    run = run_of("stress", ["quick=true"])
    write_config(run, tmp_path)
    assert capsys.readouterr().out == f"config: {tmp_path / 'config.yaml'} (no overrides)\n"
    assert OmegaConf.load(tmp_path / "config.yaml") == run.plain
    write_config(run, tmp_path)  # its own file


def test_flags_may_stand_anywhere():
    """Hydra accepts no flags between overrides."""
    flags, overrides, _ = parse_arguments(["seed=1", "-m", "--config-dir", "x", "seed=2"])
    assert (flags, overrides) == (["-m", "--config-dir", "x"], ["seed=1", "seed=2"])
    assert parse_arguments(["--cfg=job", "seed=1"])[:2] == (["--cfg=job"], ["seed=1"])


class Seeded(BaseException):
    """Ends a verb at the point where it seeds the process."""


@pytest.mark.parametrize("verb", ["train", "pretext"])
def test_random_numbers_of_a_process_are_those_of_the_seed(monkeypatch, capsys, tmp_path, verb):
    """Initial weights of a model are random."""

    def ended(seed, **options):
        raise Seeded(seed)

    monkeypatch.setattr("lightning.pytorch.seed_everything", ended)
    with pytest.raises(Seeded, match=r"^5$"):
        call(monkeypatch, capsys, verb, "seed=5", f"hydra.run.dir={tmp_path}")


@pytest.mark.parametrize(
    "arguments",
    [
        ["predict", "images=nowhere", "cameras=nowhere.json", "out=person"],
        ["evaluate", "baselines=[hull]", "data=scans", "data.root=nowhere"],
        ["train", "data=scans", "data.root=nowhere"],
        ["train", "seed=nowhere"],
    ],
)
def test_a_wrong_value_leaves_no_run(monkeypatch, capsys, tmp_path, arguments):
    """The list of runs must not fill up with runs that never began."""
    monkeypatch.chdir(tmp_path)
    assert ghgs(*arguments, "hydra.run.dir=run") == 1
    assert "nowhere" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_what_was_there_before_an_error_stays(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "notes.txt").write_text("mine")
    assert ghgs("train", "seed=abc", f"hydra.run.dir={tmp_path / 'run'}") == 1
    assert (tmp_path / "run" / "notes.txt").read_text() == "mine"


def test_nothing_is_written_through_a_link(tmp_path, monkeypatch, capsys):
    """An untrusted run folder may contain links to the user's files, which Hydra would overwrite."""
    run, precious = tmp_path / "run", tmp_path / "precious"
    run.mkdir()
    precious.write_text("precious")
    path = run / "table.log"
    path.symlink_to(precious)
    code, _, err = call(monkeypatch, capsys, "table", f"runs={tmp_path}", f"hydra.run.dir={run}")
    expected = f"ghgs table: {path}: expected a file or folder of the run; found 'a link'\n"
    assert (code, err) == (1, expected)
    assert precious.read_text() == "precious"
    assert list(run.iterdir()) == [path]
