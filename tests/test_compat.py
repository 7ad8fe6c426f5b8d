"""The release's quirks are switches that are off by default; new training uses safe alternatives."""

import pytest
import torch
from omegaconf import OmegaConf

from ghgs_lit.config import compose, conf_dir
from ghgs_lit.geometry.projection import project
from ghgs_lit.geometry.unprojection import Unprojection
from ghgs_lit.method.bounds import SubjectBox
from ghgs_lit.method.heads.depth import BOUNDED, DepthHeadOptions
from ghgs_lit.method.model import GHGS
from ghgs_lit.types import Batch, Cameras, DepthMaps, Tokens
from ghgs_lit.weights import published
from ghgs_lit.weights.switches import release_switches
from tests.helpers.models import config, make_model, predict
from tests.helpers.plans import plan_of
from tests.helpers.scenes import make_batch
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
    assert cfg["metrics"]["regions"] == ["image"]
    assert cfg["metrics"]["lpips"] == "require"  # required to compare with the paper
    assert chosen["metrics"]["protocol"] == "correct"


def token_pixels(mode, size=512):
    """Pixel coordinates of the tokens of two full masks: ``[37, 37, 2]``."""
    batch = make_batch(1, 2, size, size)
    depth = torch.full_like(batch.depths, 2.0)
    padded = torch.nn.functional.pad(depth, (3, 3, 3, 3), value=2.0)
    full = torch.ones_like(padded, dtype=torch.bool)
    rows = (size + 6) // 14
    axes = (torch.arange(n) for n in (2, rows, rows))
    image, row, column = (axis.flatten() for axis in torch.meshgrid(*axes, indexing="ij"))
    latent = torch.zeros(len(image), 1)
    tokens = Tokens((latent,), latent, image, row, column, (1, 2, rows, rows), 14)
    inner = Batch(torch.zeros(*full.shape[:2], 3, *full.shape[2:]), full,
                  batch.cameras.cropped(-3, -3, size + 6, size + 6))  # fmt: skip
    points = Unprojection(tokens=mode)(DepthMaps(padded, full, padded), tokens, inner)
    cameras: Cameras = batch.cameras[0]
    pixel, _ = project(points.tokens, cameras.intrinsics[image], cameras.extrinsics[image])
    return pixel.reshape(2, rows, rows, 2)[0]


def test_tokens_lie_at_the_true_centres_and_the_releases_where_it_puts_them():
    """Token points are correct by default, and shifted as in the release with its switch."""
    index = torch.arange(37) + 0.5
    v, u = torch.meshgrid(index, index, indexing="ij")
    grid = torch.stack((u, v), -1)
    true, quirk = 14 * grid - 3, grid * 512 / 37
    torch.testing.assert_close(token_pixels("subject"), true, atol=2e-3, rtol=0)
    torch.testing.assert_close(token_pixels("release"), quirk, atol=2e-3, rtol=0)
    # As measured with the authors' code: up to 2.92 px per axis, 0 at the centre.
    assert (true - quirk).abs().max() == pytest.approx(2.92, abs=5e-3)


EXTREMES = torch.tensor([-torch.inf, -1e30, -1e4, -80.0, 0.0, 80.0, 1e4, 1e30, torch.inf])


@pytest.mark.parametrize("name", list(BOUNDED))
def test_no_value_of_the_head_flips_or_explodes_a_depth(name):
    """For any network output, depths lie between near and far, and their gradients are bounded."""
    batch = make_batch(1, 3)
    torch.manual_seed(0)
    head = DepthHeadOptions(parameterization=name).build(64)
    tokens = torch.zeros(3 * 16, 64)
    axes = (torch.arange(n) for n in (3, 4, 4))
    image, row, column = (axis.flatten() for axis in torch.meshgrid(*axes, indexing="ij"))
    packed = Tokens((tokens,) * 4, tokens, image, row, column, (1, 3, 4, 4), 14)
    last = head.dpt.scratch.output_conv2[-1]
    for value in EXTREMES:
        with torch.no_grad():
            last.bias[0] = value
        maps = head(packed, batch, SubjectBox()(batch), plan_of(batch.masks))
        assert torch.equal(maps.valid, batch.masks)
        assert (maps.bounds.near > 0).all()
        assert (maps.depth >= maps.bounds.near * (1 - 1e-6)).all()
        assert (maps.depth <= maps.bounds.far * (1 + 1e-6)).all()
        last.bias.grad = None
        maps.depth.sum().backward()
        assert last.bias.grad.isfinite().all()
        assert last.bias.grad[0] <= (maps.bounds.far - maps.bounds.near).sum()


def test_a_fresh_model_of_the_release_may_look_behind_the_camera_and_ours_not():
    """Eight of twenty seeds of the release's parameterization put the body behind every camera."""
    batch = make_batch(1, 3)
    behind = {name: 0 for name in ("paper", "release")}
    for seed in range(6):
        for name in behind:
            overrides = ["model=paper"] + ["compat=release"] * (name == "release")
            with torch.no_grad():
                depth = predict(make_model(*overrides, seed=seed), batch).depth[batch.masks]
            behind[name] += bool((depth <= 0).any())
    assert behind["paper"] == 0
    assert behind["release"] > 0


def test_background_tokens_take_part_by_a_switch():
    """Background tokens take part only with recalibration.tokens=all."""
    batch = make_batch(1, 3, 56, 56, zoom=0.4)
    touched = {}
    for tokens in ("subject", "all"):
        model = make_model("model=paper", f"recalibration.tokens={tokens}")
        calls = []
        model.recalibration.block.register_forward_hook(lambda _, args, out, c=calls: c.append(len(args[0])))
        with torch.no_grad():
            predict(model, batch)
        touched[tokens] = calls[0]
    assert touched["all"] == 3 * 16
    assert touched["subject"] < touched["all"]
