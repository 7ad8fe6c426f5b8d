"""YAML files contain only differences from the defaults of classes; composed configurations are complete."""

import json

import pytest
import yaml
from omegaconf import OmegaConf
from pydantic import Field

from ghgs_lit.config import compose, conf_dir, run_of
from ghgs_lit.config.defaults import with_defaults
from ghgs_lit.config.keys import flatten
from ghgs_lit.config.options import Count, Options, Size
from ghgs_lit.config.registry import KINDS, class_of_node, nodes_of, verb_class, verbs
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


def find_restated(values, defaults, path):
    said = flatten(defaults)
    return [f"{path}: {key}" for key, value in flatten(values).items() if key in said and said[key] == value]


@pytest.mark.parametrize("group", sorted(KINDS.keys() - {"model", "compat", "rounds"}))
def test_no_option_restates_a_default(group):
    """Values stated twice would diverge some day; the exceptions are referred to by other keys."""
    wrong = []
    for path in sorted((conf_dir() / group).glob("*.yaml")):
        content = yaml.safe_load(path.read_text()) or {}
        bases = [name for name in content.pop("defaults", []) if isinstance(name, str) and name != "_self_"]
        if bases:  # an option derived from another one may reset a key
            continue
        for key, node in nodes_of({group: content}):
            if "kind" in node or None in KINDS[group]:
                wrong += find_restated(node, with_defaults({}, class_of_node(node, key)), path.stem)
    referred = ("synthetic: size", "random: evaluation_count")
    assert [key for key in wrong if key not in referred and not key.endswith(": name")] == []


@pytest.mark.parametrize("verb", [verb for verb in verbs() if (conf_dir() / f"{verb}.yaml").is_file()])
def test_no_verb_restates_a_default(verb):
    content = yaml.safe_load((conf_dir() / f"{verb}.yaml").read_text())
    own = {name: value for name, value in content.items() if name in verb_class(verb).model_fields}
    assert find_restated(own, with_defaults({}, verb_class(verb)), verb) == []


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
        ("trainer.profiler=simple", "trainer.profiler", "simple"),
        ("+trainer.profiler=simple", "trainer.profiler", "simple"),
        ("++trainer.profiler=simple", "trainer.profiler", "simple"),
        ("gaussian_head.attributes.inward=0.25", "gaussian_head.attributes.inward", 0.25),
        ("optimizer.freeze_until.encoder=0.5", "optimizer.freeze_until.encoder", 0.5),
        ("callbacks.pictures.subjects=2", "callbacks.pictures.subjects", 2),
        # a key that no file sets
        ("trainer.profiler=${data.resampling}", "trainer.profiler", "area"),
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
