"""Every YAML that ships composes; everything with a kind in it can be built."""

import functools
import importlib.util
import itertools

import pytest
import torch
from omegaconf import OmegaConf

from ghgs_lit.cli.usage import VERBS
from ghgs_lit.config import build, conf_dir
from ghgs_lit.config.keys import ablation_of, switches_of
from ghgs_lit.errors import InputError
from ghgs_lit.model import GHGS, OPTIONS, STAGES
from tests.helpers.configs import composed, verb_with

CONF = conf_dir()
GROUPS = sorted(path.name for path in CONF.iterdir() if path.is_dir() and path.name != "hydra")
MEMBERS = [(group, path.stem) for group in GROUPS for path in sorted((CONF / group).glob("*.yaml"))]


def nodes_with_kind(node, key=""):
    """The outermost nodes that describe an object."""
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


@pytest.mark.parametrize("verb", sorted(VERBS))
def test_every_verb_composes(verb):
    """A broken defaults list would make a verb unusable."""
    assert composed(verb)


@functools.cache
def parameters_of(stages):
    """The number of parameters of the model of ``stages`` (YAML), built once."""
    with torch.device("meta"):
        return sum(p.numel() for p in GHGS.from_config(OmegaConf.create(stages)).parameters())


@pytest.mark.parametrize(("group", "name"), MEMBERS, ids=[f"{g}={n}" for g, n in MEMBERS])
def test_every_member_composes_and_its_model_is_built(group, name):
    """A shipped option that does not compose, or builds no model, would fail only for its first user."""
    # Depths without bounds belong to the release's model alone.
    fitting = ["compat=release"] if (group, name) == ("bounds", "none") else []
    cfg = composed(verb_with(group), f"{group}={name}", *fitting)
    nodes = {*STAGES, *OPTIONS, "rounds", "compat"}
    stages = {key: node for key, node in OmegaConf.to_container(cfg, resolve=True).items() if key in nodes}
    assert parameters_of(OmegaConf.to_yaml(stages)) > 0


OUTSIDE_THE_MODEL = [
    (group, name)
    for group, name in MEMBERS
    if group not in {"encoder", "depth_head", "recalibration", "gaussian_head", "model", "ablation", "compat"}
]


@pytest.mark.parametrize(("group", "name"), OUTSIDE_THE_MODEL, ids=[f"{g}={n}" for g, n in OUTSIDE_THE_MODEL])
def test_every_object_outside_the_model_is_built(group, name, tmp_path):
    """A shipped option with a misspelt argument would fail only for its first user."""
    cfg = composed(verb_with(group), f"{group}={name}")
    node = cfg.get(group)
    if node is None:
        return
    extra = {
        "data": {"views": cfg.views, "targets": cfg.get("targets"), "seed": 0},
        "logger": {"save_dir": str(tmp_path)},
    }.get(group, {})
    for key, part in nodes_with_kind(node, group):
        if group == "trainer":  # one for a GPU refuses to be made where there is none
            part = {**part, "accelerator": "cpu"}
        if key == "logger.wandb" and importlib.util.find_spec("wandb") is None:
            with pytest.raises(InputError, match=r"ghgs-lit\[wandb\]"):
                build(part, key, **extra)
            continue
        if (group, name) == ("metrics", "release") and importlib.util.find_spec("torchvision") is None:
            with pytest.raises(InputError, match=r"ghgs-lit\[lpips\]"):
                build(part, key, **extra)
            continue
        assert build(part, key, **extra) is not None


@pytest.mark.parametrize(
    ("views", "ablation"),
    list(itertools.product(["v3", "v4", "v5"], ["full", "no_unprojection", "no_semantic", "neither"])),
)
def test_the_papers_grid_composes(views, ablation):
    """The rows that tables read from the model must be those of the option's name."""
    cfg = composed("train", f"views={views}", f"ablation={ablation}", "model=paper")
    assert switches_of(cfg) == (ablation in ("full", "no_semantic"), ablation in ("full", "no_unprojection"))
    assert ablation_of(cfg) == ablation


def test_a_command_line_choice_wins_over_the_models():
    """A named model must not silently replace a group that the user chose."""
    assert (
        composed("train", "model=paper", "encoder=vggt_small").encoder.width
        != composed("train", "model=paper", "encoder=vggt_nano").encoder.width
    )
