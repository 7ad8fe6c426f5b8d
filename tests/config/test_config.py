"""Every YAML that ships composes; everything with a ``_target_`` in it can be built."""

import importlib.util
import itertools

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from ghgs_lit.cli.main import VERBS
from ghgs_lit.config import build, conf_dir
from ghgs_lit.errors import InputError
from ghgs_lit.model import GHGS

CONF = conf_dir()
GROUPS = sorted(path.name for path in CONF.iterdir() if path.is_dir() and path.name != "hydra")
MEMBERS = [(group, path.stem) for group in GROUPS for path in sorted((CONF / group).glob("*.yaml"))]


def composed(verb: str, *overrides: str):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose(verb, overrides=list(overrides))


def nodes_with_target(node, key=""):
    """The outermost nodes that describe an object."""
    if OmegaConf.is_dict(node):
        if "_target_" in node:
            yield key, node
            return
        for name in node:
            if not OmegaConf.is_missing(node, name):
                yield from nodes_with_target(node[name], f"{key}.{name}" if key else str(name))
    elif OmegaConf.is_list(node):
        for index, item in enumerate(node):
            yield from nodes_with_target(item, f"{key}[{index}]")


@pytest.mark.parametrize("verb", sorted(VERBS))
def test_every_verb_composes(verb):
    cfg = composed(verb)
    assert OmegaConf.is_dict(cfg)


@pytest.mark.parametrize(("group", "name"), MEMBERS, ids=[f"{g}={n}" for g, n in MEMBERS])
def test_every_member_composes_and_its_model_is_built(group, name):
    # Depths without bounds are of the release's model alone.
    fitting = ["compat=release"] if (group, name) == ("bounds", "none") else []
    cfg = composed("train", f"{group}={name}", *fitting)
    with torch.device("meta"):
        model = GHGS.from_config(cfg)
    assert sum(p.numel() for p in model.parameters()) > 0


OUTSIDE_THE_MODEL = [
    (group, name)
    for group, name in MEMBERS
    if group not in {"encoder", "depth_head", "recalibration", "gaussian_head", "model", "ablation", "compat"}
]


@pytest.mark.parametrize(("group", "name"), OUTSIDE_THE_MODEL, ids=[f"{g}={n}" for g, n in OUTSIDE_THE_MODEL])
def test_every_object_outside_the_model_is_built(group, name, tmp_path):
    cfg = composed("train", f"{group}={name}")
    node = cfg.get(group)
    if node is None:
        return
    extra = {
        "data": {"views": cfg.views, "targets": cfg.targets, "seed": 0, "root": str(tmp_path)},
        "logger": {"save_dir": str(tmp_path)},
        # A Trainer for a GPU refuses to be made where there is none.
        "trainer": {"accelerator": "cpu"},
    }.get(group, {})
    if name == "synthetic":
        extra.pop("root")
    for key, part in nodes_with_target(node, group):
        if key == "logger.wandb" and importlib.util.find_spec("wandb") is None:
            with pytest.raises(InputError, match=r"ghgs-lit\[wandb\]"):
                build(part, key, **extra)
            continue
        assert build(part, key, **extra) is not None


@pytest.mark.parametrize(
    ("views", "ablation"),
    list(itertools.product(["v3", "v4", "v5"], ["full", "no_unprojection", "no_semantic", "neither"])),
)
def test_the_papers_grid_composes(views, ablation):
    cfg = composed("train", f"views={views}", f"ablation={ablation}", "model=paper")
    assert cfg.ablation.unprojection == (ablation in ("full", "no_semantic"))
    assert cfg.ablation.semantic == (ablation in ("full", "no_unprojection"))


def test_a_command_line_choice_wins_over_the_models():
    assert (
        composed("train", "model=paper", "encoder=vggt_small").encoder.width
        != composed("train", "model=paper", "encoder=vggt_nano").encoder.width
    )


@pytest.mark.parametrize("target", ["os.system", "subprocess.run", "ghgs_litter.x", "torch.load"])
def test_only_the_whitelist_is_called(target):
    with pytest.raises(InputError, match=r"callbacks\.x\._target_"):
        build({"_target_": "ghgs_lit.model.GHGS", "x": {"_target_": target}}, "callbacks")


def test_an_unknown_argument_is_named():
    with pytest.raises(InputError, match="colour"):
        build({"_target_": "ghgs_lit.rendering.Renderer", "colour": "red"}, "renderer")
