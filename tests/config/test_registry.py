"""A configuration names kinds of options; no value in it imports or calls code."""

import contextlib

import pytest

from ghgs_lit.config import build, registry
from ghgs_lit.config.options import Options
from ghgs_lit.config.registry import KINDS, NAMED, read_node, register
from ghgs_lit.errors import InputError
from ghgs_lit.method.model import GHGS
from tests.helpers.configs import composed, verb_with
from tests.helpers.weights import config

EXTRA = {"data": {"views": {}, "targets": {"name": "cameras"}}, "logger": {"save_dir": "."}}

#: Required keys of nodes without kinds.
NAMES = {"views": {}, "targets": {"name": "release"}}


def key_of(group):
    return f"{group}.x" if group in NAMED else group


OUTSIDE = ["os.system", "subprocess.run", "builtins.eval", "torch.load", "lightning.pytorch.Trainer"]


@pytest.mark.parametrize("group", sorted(KINDS))
def test_no_function_or_class_is_a_kind_by_its_path(group):
    """Regression: ``_target_`` with the path of a function in a checkpoint executed the function."""
    for path in (*OUTSIDE, *KINDS[group].values()):
        with pytest.raises(InputError, match=rf"{group}.*(kind|expected one of)"):
            build({**NAMES.get(group, {}), "kind": path}, key_of(group))


@pytest.mark.parametrize("group", sorted(KINDS))
def test_keys_of_hydras_instantiate_have_no_effect(group, tmp_path):
    """At every node and nested: values in a file are data."""
    verb = verb_with(group)
    node = composed(verb, *["model=recurrent"] * (verb == "train")).get(group)
    if group in NAMED:
        name = next(iter(node))
        node = node[name]
    call = {"_target_": "pathlib.Path.touch", "_args_": [str(tmp_path / "called")]}
    for key in ("_target_", "_partial_", "_args_", "_convert_", "_recursive_"):
        with pytest.raises(InputError, match=f"{key}|expected"):
            build({**dict(node), key: call}, key_of(group), **EXTRA.get(group, {}))
    for name in node:
        if name == "kind":
            continue
        with contextlib.suppress(Exception):  # whatever the result
            build({**dict(node), name: call}, key_of(group), **EXTRA.get(group, {}))
    assert not (tmp_path / "called").exists()


@pytest.mark.parametrize("stage", ["bounds", "encoder", "depth_head", "recalibration", "gaussian_head"])
def test_a_model_is_built_of_kinds_alone(stage):
    """The same holds for the nodes of a checkpoint."""
    settings = config()
    settings[stage] = {"_target_": "subprocess.run", "args": ["false"]}
    with pytest.raises(InputError, match=rf"{stage}\.kind: expected"):
        GHGS.from_config(settings)


def test_kinds_of_the_users_own(monkeypatch):
    """A registered kind is read and built like those of the package, and replaces none of them."""
    monkeypatch.setattr(registry, "_REGISTERED", dict(registry._REGISTERED))

    @register("bounds", "sphere")
    class Sphere(Options):
        radius: float = 1.0

        def build(self):
            return f"a sphere of {self.radius} m"

    assert build({"kind": "sphere", "radius": 2}, "bounds") == "a sphere of 2.0 m"
    with pytest.raises(
        InputError, match=r"bounds\.radios: expected one of radius; found 'radios' \(did you mean radius"
    ):
        read_node({"kind": "sphere", "radios": 2}, "bounds")
    with pytest.raises(
        InputError, match=r"bounds\.kind: expected one of box, hull, none, sphere; found 'spere'"
    ):
        read_node({"kind": "spere"}, "bounds")
    with pytest.raises(InputError, match="a new kind of bounds; found 'hull'"):
        register("bounds", "hull")(Sphere)
    with pytest.raises(InputError, match=r"register: expected one of .*; found 'shape'"):
        register("shape", "sphere")(Sphere)


def test_a_node_without_a_kind_names_those_that_there_are():
    with pytest.raises(InputError, match=r"bounds\.kind: expected one of box, hull, none; found None"):
        build({}, "bounds")
    with pytest.raises(InputError, match=r"bounds: expected a mapping of its keys; found 'box'"):
        build("box", "bounds")
