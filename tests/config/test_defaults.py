"""YAML files contain only differences from the defaults of classes; composed configurations are complete."""

import json

import pytest
from omegaconf import OmegaConf
from pydantic import Field

from ghgs_lit.config import compose, run_of
from ghgs_lit.config.defaults import with_defaults
from ghgs_lit.config.options import Count, Options, Size
from ghgs_lit.config.registry import KINDS, class_of_node, nodes_of
from tests.helpers.configs import composed, verb_with
from tests.helpers.verbs import succeed


class Inner(Options):
    width: Count = 4
    sizes: tuple[Count, ...] = (1, 2)


class Outer(Options):
    must: Count
    size: Size = 140
    inner: Inner = Inner(width=8)
    maybe: Inner | None = None
    shares: dict[str, float] = Field({"a": 0.5})


def test_what_is_not_said_is_the_default():
    """A partial inner mapping is merged over the default of its field; other mappings are complete
    values."""
    full = with_defaults({"inner": {"sizes": [3]}, "maybe": {}, "shares": {"b": 1.0}, "new": 1}, Outer)
    inner = {"width": 8, "sizes": [3]}
    nested = {"inner": inner, "maybe": {"width": 4, "sizes": [1, 2]}, "shares": {"b": 1.0}}
    assert full == {"size": 140, **nested, "new": 1}
    assert list(with_defaults({"must": 1}, Outer)) == ["must", "size", "inner", "maybe", "shares"]
    read = Outer.read({"must": 1, "inner": {"sizes": [3]}, "maybe": {}, "shares": {"b": 1.0}}, "x")
    assert json.loads(read.model_dump_json()) == {"must": 1, "size": [140, 140], **nested}


@pytest.mark.parametrize("group", sorted(KINDS))
def test_a_composed_configuration_has_every_key(group):
    """Runs save it: defaults of classes may change, but not the values that a run used."""
    cfg = composed("train", "model=recurrent") if group == "rounds" else composed(verb_with(group))
    for key, node in nodes_of(OmegaConf.to_container(cfg, resolve=True)):
        if key.split(".")[0] == group:
            cls = class_of_node(node, key)
            assert node.keys() - {"kind"} == cls.model_fields.keys() - {"kind"}
            assert cls.read({k: v for k, v in node.items() if k in cls.model_fields}, key)


@pytest.mark.parametrize(
    ("override", "key", "value"),
    [
        ("trainer.deterministic=warn", "trainer.deterministic", "warn"),
        ("+trainer.deterministic=warn", "trainer.deterministic", "warn"),
        ("++trainer.deterministic=warn", "trainer.deterministic", "warn"),
        ("gaussian_head.attributes.inward=0.25", "gaussian_head.attributes.inward", 0.25),
        ("optimizer.freeze_until.encoder=0.5", "optimizer.freeze_until.encoder", 0.5),
        ("callbacks.pictures.subjects=2", "callbacks.pictures.subjects", 2),
        # a key that no file sets
        ("trainer.deterministic=${data.resampling}", "trainer.deterministic", "area"),
    ],
)
def test_a_key_that_no_file_says_can_be_set(override, key, value):
    cfg = compose("train", ["data=scans", override])
    assert OmegaConf.select(cfg, key) == value


def test_an_inner_key_leaves_the_others_at_the_default_of_their_field():
    """Regression: scans, which are rendered without lights, had the lights of built-in people."""
    data = run_of("prepare", ["data=scans", "data.render.quality=90"]).plain["data"]
    assert (data["render"]["lights"], data["render"]["quality"]) == ("none", 90)


def test_cfg_prints_all(monkeypatch, capsys):
    out = succeed(capsys, "train", "--cfg", "job")
    assert OmegaConf.create(out) == composed("train")
    out = succeed(capsys, "table", "--cfg", "job")
    assert OmegaConf.to_container(OmegaConf.create(out))["runs"] == "???"
