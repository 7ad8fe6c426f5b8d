"""Configurations of earlier versions describe the same models and name classes that exist."""

from importlib import import_module
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from ghgs_lit.config import compose, conf_dir, legacy, resolve
from ghgs_lit.config.build import _targets
from ghgs_lit.config.keys import flatten, lookup
from ghgs_lit.config.legacy import KEYS, TARGETS, VALUES, upgrade
from ghgs_lit.model import GHGS, STAGES
from tests.helpers.models import config

OLD = OmegaConf.to_container(OmegaConf.load(Path(__file__).parents[1] / "fixtures" / "old_configs.yaml"))
#: Keys of today that a model of before has no value for, and that change none of its numbers.
NEW = ("model.check_inputs", "skip.budget_db", "skip.max_rel_diff")
NEW += ("depth_head.dpt.rectified_skip", "gaussian_head.dpt.rectified_skip")
NEW += ("gaussian_head.low_pass", "gaussian_head.antialiased", "model.frame")
NEW += ("gaussian_head.axes", "gaussian_head.attributes.inward")
NEW += ("encoder.semantic", "optimizer.matrix_lr", "rounds.exchange")
NEW += ("data.active.train", "data.active.val")
TODAY = {
    "demo": ["experiment=demo"],
    "release": ["experiment=thuman2", "encoder=vggt_nano", "compat=release"],
}


def nested(key, value):
    """A configuration of one dotted key."""
    for name in reversed(key.split(".")):
        value = {name: value}
    return value


def targets(node):
    """Every ``_target_`` in a configuration."""
    return {value for key, value in flatten(node).items() if key.endswith("_target_")}


def shipped_keys():
    """Every key, of any option, that the shipped configurations have, and the nodes above it."""
    found = set()
    for path in conf_dir().rglob("*.yaml"):
        is_global = "@package _global_" in path.read_text().splitlines()[0]
        group = () if is_global else path.relative_to(conf_dir()).parts[:-1]
        for key in flatten(OmegaConf.to_container(OmegaConf.load(path))):
            parts = (*group, *key.split("."))
            found |= {".".join(parts[:end]) for end in range(1, len(parts) + 1)}
    return found


def test_keys_classes_and_values_are_renamed(monkeypatch):
    """Each kind of table must work, for values and whole nodes, without a change of its input."""
    monkeypatch.setattr(legacy, "TARGETS", {"old.Class": "new.Class"})
    monkeypatch.setattr(legacy, "KEYS", {"a.b": "c.d.e", "node": "c.node", "absent.key": "c.absent"})
    monkeypatch.setattr(legacy, "VALUES", {("c.mode", "old"): "new"})
    monkeypatch.setattr(legacy, "STEPS", [lambda config: config.update(step=True)])
    before = {
        "a": {"b": 1, "rest": 2},
        "node": {"x": [{"_target_": "old.Class"}]},
        "c": {"mode": "old", "text": "old.Class"},
    }
    stored = repr(before)
    assert legacy.upgrade(before) == {
        "a": {"rest": 2},
        "c": {
            "mode": "new",
            "text": "old.Class",
            "d": {"e": 1},
            "node": {"x": [{"_target_": "new.Class"}]},
        },
        "step": True,
    }
    assert repr(before) == stored


def test_todays_configuration_is_unchanged():
    """A table that changes a name of today would damage every checkpoint that is read."""
    config = resolve(compose("train"))
    assert legacy.upgrade(config) == config
    assert not {target for _, target in _targets(config)} & set(legacy.TARGETS)


@pytest.mark.parametrize("name", list(OLD))
def test_an_old_configuration_builds_the_same_model(name):
    """Checkpoints of earlier versions must still load: same tensors, and the same choices without tensors."""
    with torch.device("meta"):
        old, new = (GHGS.from_config(c) for c in (upgrade(OLD[name]), config(*TODAY[name])))
    shapes = [{key: value.shape for key, value in model.state_dict().items()} for model in (old, new)]
    assert shapes[0] == shapes[1]
    assert shapes[0]
    assert (type(old.bounds), old.unprojection) == (type(new.bounds), new.unprojection)
    assert vars(old.bounds) == vars(new.bounds)
    assert [(m.encoder.tokens, m.encoder.margin, m.pad, m.depth_head.pixels) for m in (old, new)] == [
        (new.encoder.tokens, new.encoder.margin, new.pad, new.depth_head.pixels)
    ] * 2
    assert old.gaussian_head.pixels == "subject"


@pytest.mark.parametrize("name", list(OLD))
def test_an_upgraded_configuration_is_todays(name):
    """A run of today that resumes an old one must find no difference but those that were made."""
    old, today = upgrade(OLD[name]), config(*TODAY[name])
    nodes = (*STAGES, "skip", "model", "compat")
    changed = {
        key: (flatten(old).get(key), value)
        for node in nodes
        for key, value in flatten(today[node], node).items()
        if flatten(old).get(key) != value and key not in NEW
    }
    assert changed == {}
    assert upgrade(old) == old
    assert upgrade(today) == today


@pytest.mark.parametrize("name", list(OLD))
def test_every_class_of_an_old_configuration_exists(name):
    """Data and callbacks of an old checkpoint are built from its configuration, too."""
    for target in targets(upgrade(OLD[name])):
        module, attribute = target.rsplit(".", 1)
        assert hasattr(import_module(module), attribute), target


def test_an_upgrade_leaves_its_argument_alone():
    """The configuration of a checkpoint is read more than once."""
    before = flatten(OLD["demo"])
    assert upgrade(OLD["demo"]) != OLD["demo"]
    assert flatten(OLD["demo"]) == before


@pytest.mark.parametrize(("old", "new"), KEYS.items())
def test_a_key_moves_to_one_that_exists(old, new):
    """An entry that names no key of today would lose the value in silence."""
    keys = shipped_keys()
    assert new in keys
    assert old not in keys
    value = {"x": 1}
    upgraded = upgrade(nested(old, value))
    assert lookup(upgraded, new)["x"] == 1
    assert lookup(upgraded, old) is None


@pytest.mark.parametrize(("old", "new"), TARGETS.items())
def test_a_class_moves_to_one_that_exists(old, new):
    """A ``_target_`` that cannot be imported makes a checkpoint unreadable."""
    module, name = new.rsplit(".", 1)
    assert hasattr(import_module(module), name)
    assert targets(upgrade({"a": {"b": {"_target_": old}}})) == {new}


@pytest.mark.parametrize(("place", "new"), VALUES.items())
def test_a_value_gets_its_new_name(place, new):
    """An option that was renamed must not be refused as unknown."""
    key, old = place
    assert lookup(upgrade(nested(key, old)), key) == new
    assert lookup(upgrade(nested(key, "other")), key) == "other"


@pytest.mark.parametrize(
    ("bounds", "search", "expected"),
    [
        ("box", {"dilation": 0.02, "samples": 48}, {"_target_": "SubjectBox", "dilation": 0.02}),
        ("hull", {"samples": 32}, {"_target_": "VisualHull", "samples": 32}),
        ("none", {"samples": 48}, {"_target_": "NoBounds"}),
    ],
)
def test_bounds_of_the_depth_head_become_a_stage(bounds, search, expected):
    """The search of an old depth head belongs to the stage that does it now."""
    upgraded = upgrade({"depth_head": {"start": 0.5, "bounds": bounds, "search": search}})
    assert upgraded["depth_head"] == {"start": 0.5}
    assert upgraded["bounds"] == {**expected, "_target_": f"ghgs_lit.bounds.{expected['_target_']}"}
    assert upgraded["unprojection"]["_target_"].endswith("Unprojection")


@pytest.mark.parametrize(("tokens", "pixels"), [("subject", "subject"), ("all", "all")])
def test_heads_get_what_skipping_said(tokens, pixels):
    """With all tokens recalibrated, a view without the subject still needs its depth."""
    old = {"skip": {"views": "subject", "pixels": "all"}, "depth_head": {}, "gaussian_head": {"views": "all"}}
    upgraded = upgrade(old | {"recalibration": {"tokens": tokens}})
    assert upgraded["depth_head"] == {"pixels": pixels}
    assert upgraded["gaussian_head"] == {"pixels": "all"}
    assert upgraded["skip"]["depth_pixels"] == {"subject": "subject", "all": "all"}
    assert "views" not in upgraded["skip"]


def test_an_ablation_is_what_the_model_does():
    """The node that repeated it is dropped; where it is all that a result says, it is kept as switches."""
    labels = {"name": "no_semantic", "unprojection": True, "semantic": False}
    switches = {"neighborhood": "image_plane", "similarity": "product"}
    assert upgrade({"ablation": labels, "recalibration": switches}) == {"recalibration": switches}
    alone = upgrade({"ablation": labels})
    assert alone == {"recalibration": {"neighborhood": "xyz", "similarity": "none"}}


def test_encoders_kept_all_tokens():
    """A checkpoint without a choice of tokens goes on working on all of them."""
    kept = {"tokens": "all", "margin": 1}
    assert upgrade({"encoder": {"width": 8}, "skip": {"name": "balanced"}}) == {
        "encoder": {"width": 8} | kept,
        "skip": {"name": "balanced"} | kept,
    }
    fast = {"encoder": {"tokens": "subject", "margin": 0}}
    assert upgrade(fast) == fast


def test_crops_became_windows():
    """A checkpoint that was trained with crops works on the same part of the photographs."""
    window, every = {"tokens": "window", "margin": 0}, {"tokens": "all", "margin": 1}
    crops = {"skip": {"name": "balanced", "crop": True}, "encoder": {"width": 8}}
    assert upgrade(crops) == {"skip": {"name": "balanced"} | window, "encoder": {"width": 8} | window}
    whole = {"skip": {"crop": False} | every, "encoder": dict(every)}
    assert upgrade(whole) == {"skip": every, "encoder": every}
    few = {"tokens": "subject", "margin": 2}
    assert upgrade({"skip": few | {"crop": True}, "encoder": few}) == {"skip": few, "encoder": few}
    auto = {"skip": every | {"choices": {"a": every | {"crop": True}, "b": every | {"crop": False}}}}
    assert upgrade(auto) == {"skip": every | {"choices": {"a": window, "b": every}}}
