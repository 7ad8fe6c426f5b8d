"""The release's quirks are switches that are off by default; new training uses safe alternatives."""

import pytest
import torch
from omegaconf import OmegaConf

from ghgs_lit.config import compose, conf_dir
from ghgs_lit.method.model import GHGS
from ghgs_lit.weights import published
from ghgs_lit.weights.switches import release_switches
from tests.helpers.models import config
from tests.helpers.weights import PUBLISHED
from tests.helpers.weights import config as imported_config

#: Values of new models, and those of the release (docs/reproduce.md).
QUIRKS = {
    ("model", "pad"): ("none", "multiple"),
    ("unprojection", "tokens"): ("subject", "release"),
    ("depth_head", "parameterization"): ("bounded_inverse", "inverse_linear"),
    ("bounds", "kind"): ("box", "none"),
    ("recalibration", "similarity"): ("product", "product_clamped"),
    ("recalibration", "tokens"): ("subject", "all"),
    ("gaussian_head", "parameterization"): ("footprint", "release"),
}
CONF = conf_dir()
VERBS = [path.stem for path in CONF.glob("*.yaml") if "- compat:" in path.read_text()]


@pytest.mark.parametrize(("key", "values"), QUIRKS.items())
def test_every_quirk_is_a_switch_that_is_off_by_default(key, values):
    """New training must not inherit the release's quirks, and each can be selected separately."""
    group, name = key
    assert config("model=paper")[group][name] == values[0]
    assert config("model=paper", "compat=release")[group][name] == values[1]
    assert release_switches()[key] == values[1]
    overrides = [f"{group}.{name}={values[1]}"]
    if group in ("bounds", "depth_head"):  # only the release has depths without bounds
        overrides = ["bounds.kind=none", "depth_head.parameterization=inverse_linear"]
    with torch.device("meta"):
        GHGS.from_config(config("model=paper", *overrides))


@pytest.mark.parametrize("model", ["paper", "hull"])
def test_the_releases_model_has_the_releases_tensors_and_no_others(model):
    """The authors' checkpoint must fit for any chosen `model`."""
    overrides = [f"model={model}", "compat=release"]
    state = GHGS.from_config(imported_config(*overrides, tiny=False), empty=True).state_dict()
    found = {
        published.to_published(name, published.RELEASE): list(tensor.shape)
        for name, tensor in state.items()
        if not name.startswith("encoder.")
    }
    assert found == PUBLISHED["network"]


@pytest.mark.parametrize("verb", VERBS)
def test_the_releases_protocol_of_measuring_comes_with_it(verb):
    """Metrics compared with the release's must be computed as in the release."""
    cfg = OmegaConf.to_container(compose(verb, ["compat=release"]))
    chosen = OmegaConf.to_container(compose(verb, ["compat=release", "metrics=correct"]))
    assert cfg["metrics"]["protocol"] == "release"
    assert cfg["metrics"]["lpips"] == "require"  # required to compare with the paper
    assert chosen["metrics"]["protocol"] == "correct"
