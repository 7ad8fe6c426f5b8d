"""Files of ``--config-dir`` may set only listed keys of Hydra; the command line may set all."""

import os

import pytest
from omegaconf import OmegaConf

from tests.cli.test_main import call
from tests.helpers.jobs import rehearse_nothing
from tests.helpers.verbs import refuse

GLOBAL = "# @package _global_\n"
REFERENCES = "expected no interpolations but references to keys; found "
#: Rejected uses of Hydra by case: {file: text}, and the expected part of the message.
REFUSED = {
    "environment": ({"experiment/x": GLOBAL + "hydra: {job: {env_set: {A: b}}}"}, "hydra.job.env_set.A='b'"),
    "callbacks": (
        {"experiment/x": GLOBAL + "hydra: {callbacks: {a: {_target_: CALL}}}"},
        "hydra.callbacks.a._target_=",
    ),
    "logging": (
        {"experiment/x": GLOBAL + "hydra: {job_logging: {handlers: {a: {(): CALL}}}}"},
        "hydra.job_logging.handlers.a.()=",
    ),
    "a value of the grid": (
        {"experiment/x": GLOBAL + "hydra: {sweeper: {params: {seed: {_target_: CALL}}}}"},
        "hydra.sweeper.params.seed._target_=",
    ),
    "a list of the grid": (
        {"experiment/x": GLOBAL + "hydra: {sweeper: {params: {seed: [{_target_: CALL}]}}}"},
        "hydra.sweeper.params.seed=[",
    ),
    "a reference": (
        {"experiment/x": GLOBAL + "seed: {_target_: CALL}\nhydra: {sweeper: {params: {seed: '${seed}'}}}"},
        "hydra.sweeper.params.seed='${seed}'",
    ),
    "a reference for all": ({"experiment/x": GLOBAL + "hydra: {callbacks: '${data}'}"}, "hydra.callbacks="),
    "commands of a queue": (
        {"experiment/x": GLOBAL + "hydra: {launcher: {setup: [touch CALLED]}}"},
        "hydra.launcher.setup=",
    ),
    "a second line for a queue": (
        {"experiment/x": GLOBAL + 'hydra: {launcher: {partition: "a\\ntouch CALLED"}}'},
        "hydra.launcher.partition=",
    ),
    "a search path": ({"experiment/x": GLOBAL + "hydra: {searchpath: [pkg://x]}"}, "hydra.searchpath="),
    "a package": (
        {"experiment/x": "# @package hydra.job\nenv_set: {A: b}"},
        "@package: expected a package outside of hydra; found 'hydra.job'",
    ),
    "a group below a package": (
        {"experiment/x": "# @package hydra.job\ndefaults: [{/env_set: y}]", "env_set/y": "A: b"},
        "@package: expected a package outside of hydra; found 'hydra.job'",
    ),
    "a group below a group of Hydra": (
        {
            "experiment/x": GLOBAL + "defaults: [{override /hydra/job_logging: y}]",
            "hydra/job_logging/y": "defaults: [{/handlers: z}]",
            "handlers/z": "a: {(): CALL}",
        },
        "@package: expected a package outside of hydra; found 'hydra/job_logging/y'",
    ),
    "an override of the grid": (
        {"experiment/x": GLOBAL + "hydra: {sweeper: {params: {+hydra.job.env_set.A: b}}}"},
        "hydra.sweeper.params.+hydra.job.env_set.A='b'",
    ),
    "a secret": ({"experiment/x": GLOBAL + "data: {root: '${oc.env:HOME}'}"}, f"data.root: {REFERENCES}"),
    "a secret by a name that is put together": (
        {"experiment/x": GLOBAL + "trainer: {x: ['${${seed}:HOME}']}"},
        f"trainer.x: {REFERENCES}",
    ),
    "a secret behind backslashes, which a grid drops": (
        {"experiment/x": GLOBAL + "hydra: {sweeper: {params: {data.root: '$\\{oc.env:HOME\\}'}}}"},
        f"hydra.sweeper.params.data.root: {REFERENCES}",
    ),
    "a folder": (
        {"experiment/x": GLOBAL + "hydra: {sweep: {subdir: '${sqlite:CALLED/a.db}'}}"},
        f"hydra.sweep.subdir: {REFERENCES}",
    ),
    "a folder by a group": (
        {"experiment/x": GLOBAL + "defaults: [{/views: '${sqlite:CALLED/a.db}'}]"},
        f"defaults: {REFERENCES}",
    ),
    "a group of Hydra": (
        {
            "experiment/x": GLOBAL + "defaults: [{override /hydra/callbacks: y}]",
            "hydra/callbacks/y": "a: {_target_: CALL}",
        },
        "@package: expected a package outside of hydra; found 'hydra/callbacks/y'",
    ),
    "a moved group": (
        {"experiment/x": GLOBAL + "defaults: [{/views@hydra.job.env_set: y}]", "views/y": "A: b"},
        "@package: expected a package outside of hydra; found '@hydra.job.env_set'",
    ),
    "a file that is moved": (
        {
            "experiment/x": GLOBAL + "defaults: [{/views@_global_: y}]",
            "views/y": "hydra: {job: {env_set: {A: b}}}",
        },
        "views/y.yaml: hydra: ",
    ),
}


@pytest.fixture(autouse=True)
def plans_alone(monkeypatch):
    rehearse_nothing(monkeypatch)


def write_files(folder, files):
    for name, text in files.items():
        path = folder / "conf" / f"{name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text.replace("CALLED", str(folder / "called")).replace("CALL", "os.getcwd"))
    return ["--config-dir", str(folder / "conf")]


@pytest.mark.parametrize(
    ("case", "mode"),
    [*((case, "single") for case in REFUSED), ("environment", "grid"), ("a group of Hydra", "grid")],
)
def test_what_a_file_says_to_hydra_is_held_to_a_list(monkeypatch, capsys, tmp_path, case, mode):
    """Regression: ``env_set: {GHGS_PLUGINS: ...}`` in a file executed its code, and callbacks called
    functions."""
    files, message = REFUSED[case]
    flags = [*write_files(tmp_path, files), f"hydra.run.dir={tmp_path / 'run'}"]
    # A file chosen only by the second job is read when the grid is planned.
    grid = ["-m", "experiment=demo,x", f"hydra.sweep.dir={tmp_path / 'sweep'}"]
    chosen = ["experiment=x"] if mode == "single" else grid
    before = dict(os.environ)
    err = refuse(capsys, "train", *flags, *chosen, "dry_run=true")
    assert err.startswith(f"ghgs train: {tmp_path / 'conf'}")
    assert message in err
    assert not (tmp_path / "called").exists()
    assert "A" not in os.environ.keys() - before.keys()


def test_a_file_may_say_where_and_what(monkeypatch, capsys, tmp_path):
    """User-defined sweeps must work without command-line overrides."""
    sweep = """hydra:
  mode: MULTIRUN
  sweep: {dir: FOLDER/sweep}
  sweeper: {params: {seed: "1,2", data.root: "x/${data.name}"}}
"""
    flags = write_files(tmp_path, {"sweep/x": GLOBAL + sweep.replace("FOLDER", str(tmp_path))})
    command = [*flags, "data=scans", "+hydra.job.env_set.A=b", "sweep=x"]
    code, out, err = call(monkeypatch, capsys, "train", *command, "dry_run=true")
    assert (code, err) == (0, "")
    assert "2 runs: 2 missing" in out
    assert f"outputs below {tmp_path}/sweep" in out
    _, out, _ = call(monkeypatch, capsys, "train", *command, "--cfg", "hydra")
    assert OmegaConf.create(out).hydra.job.env_set.A == "b"  # the command line may set all


def test_a_searched_folder_is_a_file_from_outside_too(monkeypatch, capsys, tmp_path):
    """``hydra.searchpath`` and ``--config-path`` reach the same files in other ways."""
    files, message = REFUSED["environment"]
    folder = write_files(tmp_path, files)[1]
    flags = [f"hydra.searchpath=[{folder}]", f"hydra.run.dir={tmp_path / 'run'}"]
    err = refuse(capsys, "train", *flags, "experiment=x")
    assert message in err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "a: &a {b: *a}",
            "x.yaml: expected YAML; found an alias (*name)",
        ),
        (
            "a0: &a0 [1]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 30)),
            "x.yaml: expected YAML; found more than 100000 values",
        ),
        ("a: " + "[" * 700 + "]" * 700, "x.yaml: expected YAML; found more than 64 levels"),
        ("a: b\na: c", "x.yaml: expected YAML; found duplicate key a in line 3"),
        ("a: !!set {b}", "x.yaml: expected YAML; found Value 'set' is not a supported primitive type"),
        ("# Köpfe".encode("latin-1"), "x.yaml: expected YAML; found 'utf-8' codec can't decode byte"),
        ("a: b".encode("utf-16"), "x.yaml: expected YAML; found 'utf-8' codec can't decode byte"),
        ("- a", "x.yaml: expected keys with values; found ['a']"),
    ],
)
def test_a_file_that_is_no_plain_yaml_is_refused(monkeypatch, capsys, tmp_path, text, message):
    """Aliases in a loop, a few hundred bytes that expand to a billion values, and other encodings."""
    flags = write_files(tmp_path, {"experiment/x": GLOBAL})
    with open(tmp_path / "conf" / "experiment" / "x.yaml", "ab") as file:
        file.write(text if isinstance(text, bytes) else text.encode())
    code, _, err = call(
        monkeypatch, capsys, "train", *flags, "experiment=x", f"hydra.run.dir={tmp_path / 'r'}"
    )
    assert code == 1
    assert message in err
    assert err.count("\n") == 1


def test_a_byte_order_mark_is_no_part_of_a_file(monkeypatch, capsys, tmp_path):
    """Editors on Windows write one, also before the ``@package`` line."""
    flags = write_files(tmp_path, {"experiment/x": "\ufeff" + GLOBAL + "seed: 7"})
    code, out, _ = call(monkeypatch, capsys, "train", *flags, "experiment=x", "--cfg", "job")
    assert (code, OmegaConf.create(out).seed) == (0, 7)
