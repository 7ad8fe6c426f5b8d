"""Every shipped YAML file composes, and every node with a kind can be built."""

import functools
import importlib.util

import hydra
import pytest
import torch
from hydra import initialize_config_dir
from omegaconf import OmegaConf

from ghgs_lit.config import VERSION_BASE, build, compose, conf_dir
from ghgs_lit.config.compose import read_option
from ghgs_lit.config.keys import ablation_of, switches_of
from ghgs_lit.errors import InputError
from ghgs_lit.method.model import GHGS, OPTIONS, STAGES
from tests.cli.test_main import call
from tests.helpers.configs import composed
from tests.helpers.jobs import rehearse_nothing
from tests.helpers.verbs import refuse, succeed

CONF = conf_dir()
GROUPS = sorted(path.name for path in CONF.iterdir() if path.is_dir() and path.name != "hydra")
#: Packages that an option requires, and the extra that installs them.
NEEDS = {"metrics=release": ("torchvision", "lpips")}


def nodes_with_kind(node, key=""):
    """Outermost nodes that describe an object, with their keys."""
    if OmegaConf.is_dict(node):
        if "kind" in node and key != "targets":
            yield key, node
            return
        for name in node:
            if not OmegaConf.is_missing(node, name):
                yield from nodes_with_kind(node[name], f"{key}.{name}" if key else str(name))
    elif OmegaConf.is_list(node):
        for index, item in enumerate(node):
            yield from nodes_with_kind(item, f"{key}[{index}]")


@functools.cache
def parameters_of(stages):
    """Number of parameters of the model of ``stages`` (YAML), built once."""
    with torch.device("meta"):
        return sum(p.numel() for p in GHGS.from_config(OmegaConf.create(stages)).parameters())


@pytest.mark.parametrize("group", GROUPS)
def test_every_member_composes_and_its_model_is_built(group):
    """A shipped option that does not compose or builds no model would fail only for its first user."""
    for path in sorted((CONF / group).glob("*.yaml")):
        cfg = composed("train", f"{group}={path.stem}")
        nodes = {*STAGES, *OPTIONS, "rounds", "compat"}
        stages = {k: node for k, node in OmegaConf.to_container(cfg, resolve=True).items() if k in nodes}
        assert parameters_of(OmegaConf.to_yaml(stages)) > 0, path


INSIDE_THE_MODEL = ("encoder", "model", "ablation", "compat")


@pytest.mark.parametrize("group", sorted({*GROUPS} - {*INSIDE_THE_MODEL}))
def test_every_object_outside_the_model_is_built(group, tmp_path):
    """A shipped option with a misspelt argument would fail only for its first user."""
    for path in sorted((CONF / group).glob("*.yaml")):
        cfg = composed("train", f"{group}={path.stem}")
        extra = {
            "data": {"views": cfg.get("views"), "targets": cfg.get("targets"), "seed": 0},
            "logger": {"save_dir": str(tmp_path)},
        }.get(group, {})
        for key, part in nodes_with_kind(cfg.get(group), group):
            if group == "trainer":  # a Trainer for a GPU requires one
                part = {**part, "accelerator": "cpu"}
            lacking = NEEDS.get(key if group == "logger" else f"{group}={path.stem}")
            if lacking and importlib.util.find_spec(lacking[0]) is None:
                with pytest.raises(InputError, match=rf"ghgs-lit\[{lacking[1]}\]"):
                    build(part, key, **extra)
            else:
                assert build(part, key, **extra) is not None, path


@pytest.mark.parametrize("ablation", ["full", "no_unprojection", "no_semantic", "neither"])
def test_the_papers_ablation_composes(ablation):
    """Table rows, which are derived from the model, must match the option's name."""
    cfg = composed("train", f"ablation={ablation}", "model=paper")
    assert switches_of(cfg) == (ablation in ("full", "no_semantic"), ablation in ("full", "no_unprojection"))
    assert ablation_of(cfg) == ablation


def test_a_command_line_choice_wins_over_the_models():
    """A named model must not silently replace a group that the user chose."""
    assert (
        composed("train", "model=paper", "encoder=vggt_small").encoder.width
        != composed("train", "model=paper", "encoder=vggt_nano").encoder.width
    )


SETS = """# @package _global_
defaults:
  - override /optimizer: release
loss: {weights: {render_l1: 0.0}}
optimizer: {lr: 1.0e-5}
views: {training: uneven}
"""


@pytest.fixture
def own(monkeypatch, tmp_path):
    """``own(ablation=text)`` writes the option ``mine`` of a group and returns the flags that select its
    folder."""

    rehearse_nothing(monkeypatch)

    def write(**files):
        for group, text in files.items():
            (tmp_path / group).mkdir(exist_ok=True)
            (tmp_path / group / "mine.yaml").write_text(text)
        return ["--config-dir", str(tmp_path), f"hydra.sweep.dir={tmp_path / 'sweep'}", "dry_run=true"]

    return write


def test_what_an_ablation_sets_holds(monkeypatch, capsys, own):
    """Regression: loss, optimizer and views composed after the ablation, so its keys had no effect and
    two rows were equal."""
    flags = own(ablation=SETS)
    said = ["experiment=demo", "ablation=mine", "views.training=any"]
    out = succeed(capsys, "train", "--cfg", "job", *flags, *said)
    cfg = OmegaConf.create(out)
    assert (cfg.loss.weights.render_l1, cfg.optimizer.lr, cfg.optimizer.betas) == (0.0, 1e-5, [0.9, 0.999])
    assert cfg.views.training == "any"  # the command line wins
    out = succeed(capsys, "train", "-m", *flags, "ablation=full,mine", "seed=1,2")
    assert "4 runs: 4 missing" in out
    assert "different configurations" not in out


def test_combinations_that_are_one_configuration_are_counted(monkeypatch, capsys, own):
    """Regression: a 2 x 2 grid became two runs without a message."""
    flags = own(ablation=SETS)
    grid = ["ablation=full,mine", "seed=1,2", "loss.weights.render_l1=1", "optimizer=release"]
    grid += ["optimizer.lr=1e-5", "views.training=uneven"]
    out = succeed(capsys, "train", "-m", *flags, *grid)
    assert "4 combinations, 2 different configurations" in out


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (
            {"ablation": "# @package _global_\noptimizer: {freeze_until: {}}\n"},
            "optimizer.freeze_until: expected {}, as ablation/mine.yaml sets it; found {'gaussian_head': ",
        ),
        (
            {"ablation": "optimizer: {lr: 1}"},
            "optimizer.lr: expected 1, as ablation/mine.yaml sets it; found ",
        ),
        (
            {"experiment": "# @package _global_\ndefaults: [{override /ablation: neither}]\n"},
            "Could not override 'ablation'",
        ),
    ],
)
@pytest.mark.parametrize("mode", ["-m", "single"])
def test_a_key_of_an_ablation_that_does_not_hold_is_refused(
    monkeypatch, capsys, tmp_path, own, files, message, mode
):
    """An empty mapping is merged, and keys without the header end up below ``ablation``."""
    flags = own(**files)
    flags += ["-m"] if mode == "-m" else [f"hydra.run.dir={tmp_path / 'run'}"]
    chosen = "experiment=mine" if "experiment" in files else "ablation=mine"
    err = refuse(capsys, "train", *flags, chosen)
    assert message in err


def test_a_model_may_set_keys_of_loss_and_optimizer(monkeypatch, capsys, own):
    """As ``model=recurrent`` does. Regression: these groups composed after the model."""
    flags = own(model="# @package _global_\ndefaults: [hull, _self_]\noptimizer: {lr: 0.25}\n")
    _, out, _ = call(monkeypatch, capsys, "train", "--cfg", "job", *flags, "model=mine")
    assert OmegaConf.create(out).optimizer.lr == 0.25


def test_options_are_read_inside_another_hydra_application(tmp_path):
    """Regression: its search path lacks the package's files: ``targets: expected one of ; found
    'midway'``."""
    (tmp_path / "theirs.yaml").write_text("lr: 1\n")
    with initialize_config_dir(str(tmp_path), **VERSION_BASE):
        their = hydra.compose("theirs")
        assert read_option("targets", "midway")["name"] == "midway"
        assert compose("train", ["seed=3"]).seed == 3
        with pytest.raises(
            InputError, match=r"targets: expected one of cameras, .*; found 'midwai' \(did you"
        ):
            read_option("targets", "midwai")
        assert hydra.compose("theirs") == their
