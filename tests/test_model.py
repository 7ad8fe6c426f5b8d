"""The whole model: numbers of the release, invariances, skipping and rejected configurations."""

import dataclasses
import operator
import subprocess
import sys

import pytest
import torch
from torch import nn

import ghgs_lit
from ghgs_lit.config import conf_dir
from ghgs_lit.config.keys import ablation_of
from ghgs_lit.errors import InputError
from ghgs_lit.execution import ModelOptions, Predictor
from ghgs_lit.geometry.unprojection import Unprojection
from ghgs_lit.method.bounds import NoBounds
from ghgs_lit.method.heads.depth import DepthHeadOptions
from ghgs_lit.method.heads.dpt import DPTHead
from ghgs_lit.method.heads.gaussian import GaussianHeadOptions
from ghgs_lit.method.model import GHGS
from ghgs_lit.method.recalibration import RecalibrationOptions
from ghgs_lit.types import Batch, Cameras, Tokens
from ghgs_lit.weights.published import RELEASE, to_ours
from tests.helpers.configs import composed
from tests.helpers.models import ATTRIBUTES, close, config, make_model, predict
from tests.helpers.scenes import CASES, fixture, hard_subjects, in_dtype, make_batch, stack

PRESETS = sorted(path.stem for path in (conf_dir() / "skip").glob("*.yaml"))


class GivenTokens(nn.Module):
    """An encoder whose tokens come from a fixture."""

    patch_size, bounds_input = 14, False

    def __init__(self, inputs):
        super().__init__()
        latent = tuple(inputs[f"tokens_{layer}"][0, :, 5:].flatten(0, 1) for layer in (4, 11, 17, 23))
        axes = (torch.arange(n) for n in (3, 5, 5))
        image, row, column = (axis.flatten() for axis in torch.meshgrid(*axes, indexing="ij"))
        self.tokens = Tokens(latent, inputs["dino"].flatten(0, 1), image, row, column, (1, 3, 5, 5), 14)

    def keeps(self, masks):
        return masks.new_ones(1, 3, 5, 5)

    def forward(self, images, masks, bounds, plan):
        return self.tokens


def release_model(inputs, dtype):
    model = GHGS(
        NoBounds(),
        GivenTokens(inputs),
        DepthHeadOptions(parameterization="inverse_linear").build(64),
        Unprojection(tokens="release"),
        RecalibrationOptions(k=8, similarity="product_clamped", tokens="all").build(64),
        GaussianHeadOptions(parameterization="release").build(64),
    )
    widths = 16, (16, 20, 24, 32)  # of the fixture
    model.depth_head.dpt = DPTHead(64, 2, widths=widths)
    model.gaussian_head.decoder = DPTHead(64, 32, widths=widths)
    model.to(dtype)
    published = fixture("predict_gaussian_reduced", "state", dtype)
    model.load_state_dict({to_ours(key, RELEASE): value for key, value in published.items()})
    return model


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_pipeline_matches_the_release(dtype):
    """The whole pipeline reproduces the numbers of the authors' code."""
    name = "predict_gaussian_reduced"
    inputs, expected = fixture(name, "in", dtype), fixture(name, "out64", torch.float64)
    extrinsics = torch.eye(4, dtype=dtype).repeat(1, 3, 1, 1)
    extrinsics[..., :3, :] = inputs["extr"]
    masks = inputs["mask"][:, :, 0] != 0
    # The images are 64 x 64; the release pads them to 70 x 70 beforehand, this model by itself.
    batch = Batch(inputs["image"][..., 3:-3, 3:-3], masks, Cameras(inputs["intr"], extrinsics, 64, 64))
    model = release_model(inputs, dtype)
    prediction = Predictor(model, ModelOptions(pad="multiple", frame="world"))(batch)
    found = {
        "inv_depth": 1 / prediction.depth,
        "offset_free_points": prediction.points.pixels[masks],
        "pos": prediction.gaussians.means,
        "rot": prediction.gaussians.quaternions,
        "scale": prediction.gaussians.scales,
        "opacity": prediction.gaussians.opacities,
        "rgb": prediction.gaussians.colors,
    }
    bounds = CASES[name]["bounds"]
    for key, value in found.items():
        target = expected[key].reshape(value.shape)
        # The fixture keeps some tables in float32 (position embeddings), as the package does.
        bound = bounds[key] if dtype == torch.float32 else 1e-7 * target.abs().max().item()
        torch.testing.assert_close(
            value.double(), target, atol=bound, rtol=0, msg=lambda m, k=key: f"{k}: {m}"
        )
    layers = model.recalibration(model.encoder.tokens, prediction.points, model.plan(batch)).latent
    for layer, index in zip(layers, (4, 11, 17, 23), strict=True):
        target = fixture(name, "mid", dtype)[f"fused_{index}"][0]
        torch.testing.assert_close(layer, target, atol=bounds[f"fused_{index}"], rtol=0)


@pytest.mark.parametrize(
    ("kind", "skip", "dtype", "limit"),
    [
        ("model=paper", "exact", torch.float32, 1e-5),
        *(("model=hull", skip, torch.float32, 1e-5) for skip in PRESETS),
        # Its depth is 1/d with d crossing 0 where the subject fills a view: |depth| ranges from 2 to 1000,
        # and rounding errors grow as much (3e-5 in float32 on some processors). In float64 they are below
        # 1e-12.
        ("compat=release", "none", torch.float64, 1e-9),
    ],
    ids=lambda value: str(value).removeprefix("torch."),
)
def test_a_batch_equals_its_elements_one_by_one(kind, skip, dtype, limit):
    """Results must not depend on the other subjects of the batch."""
    singles = [in_dtype(batch, dtype) for batch in hard_subjects().values()]
    model = make_model(kind, f"skip={skip}").eval().to(dtype)
    with torch.no_grad():
        together = predict(model, stack(singles))
        tokens = []
        for b, single in enumerate(singles):
            alone = predict(model, single)
            tokens.append(alone.points.tokens)
            close(together.gaussians[b], alone.gaussians, limit)
            assert torch.equal(together.gaussians[b].image - 3 * b, alone.gaussians.image)
            assert torch.equal(together.gaussians[b].pixel, alone.gaussians.pixel)
            assert torch.equal(together.depth_valid[b], alone.depth_valid[0])
            valid = alone.depth_valid[0]
            for name in ("depth", "depth_maps.confidence", "points.pixels"):
                found, expected = (operator.attrgetter(name)(p) for p in (together, alone))
                torch.testing.assert_close(found[b][valid], expected[0][valid], rtol=limit, atol=limit)
    assert together.gaussians.means.dtype == dtype
    limit *= 10
    torch.testing.assert_close(together.points.tokens, torch.cat(tokens), rtol=limit, atol=limit)


@pytest.mark.parametrize("skip", PRESETS)
@pytest.mark.parametrize("name", list(hard_subjects()))
def test_extreme_masks_give_one_finite_gaussian_for_each_pixel(name, skip):
    """Empty, full and single-pixel masks, two people, a subject at the border: nothing is lost or NaN."""
    batch = hard_subjects()[name]
    with torch.no_grad():
        prediction = predict(make_model(f"skip={skip}"), batch)
        gaussians = prediction.gaussians
        assert gaussians.splits == (batch.masks.sum().item(),)
        assert all(getattr(gaussians, field).isfinite().all() for field in ATTRIBUTES)
        assert torch.equal(prediction.depth_valid, batch.masks)
        image, pixel = batch.masks.flatten(0, 1).flatten(1).nonzero(as_tuple=True)
        assert torch.equal(gaussians.image, image)
        assert torch.equal(gaussians.pixel, pixel)
        if skip == "exact":
            close(gaussians, predict(make_model("skip=none"), batch).gaussians)


@pytest.mark.parametrize(
    "overrides",
    [["model=paper"], ["model=hull"], ["compat=release"], ["model=hull", "skip=none"], ["skip=fast"]],
)
def test_every_parameter_gets_a_finite_gradient(overrides):
    """A parameter without a gradient would never be trained."""
    batch = make_batch(2, 3, 42, 56)
    model = make_model(*overrides)
    prediction = predict(model, batch)
    g = prediction.gaussians
    assert len(g) == batch.masks.sum()
    loss = g.means.square().mean() + g.scales.mean() + g.opacities.mean() + g.quaternions[:, 1].mean()
    loss = loss + g.colors.mean()
    (loss + prediction.depth_maps.confidence.mean()).backward()
    for name, parameter in model.named_parameters():
        if parameter.grad is None:
            assert "mask_token" in name or name.endswith("gaussian_head.decoder.norm.bias"), name
        else:
            assert parameter.grad.isfinite().all(), name


def test_ablations_differ_and_say_what_they_leave_out():
    """An ablation without effect would make a wrong table."""
    batch = make_batch(1, 3)
    outputs = {}
    for name in ("full", "no_unprojection", "no_semantic", "neither"):
        cfg = config("model=paper", f"ablation={name}")
        assert ablation_of(cfg) == name
        with torch.no_grad():
            outputs[name] = predict(make_model("model=paper", f"ablation={name}"), batch).gaussians.means
    names = list(outputs)
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            assert not torch.equal(outputs[a], outputs[b]), (a, b)


def test_an_ablation_wins_over_the_releases_values():
    """Ablations of the release's model take effect."""
    cfg = config("compat=release", "ablation=no_semantic")
    assert cfg["recalibration"]["similarity"] == "none"
    assert cfg["recalibration"]["tokens"] == "all"
    assert cfg["unprojection"]["tokens"] == "release"


def test_named_models_choose_their_parts_and_the_command_line_wins():
    """Values on the command line take precedence."""
    assert config("model=hull")["bounds"]["kind"] == "hull"
    assert config("model=paper")["bounds"]["kind"] == "box"
    assert config("model=paper", "bounds.kind=hull")["bounds"]["kind"] == "hull"
    assert composed("train", "model=paper").recalibration.k == 64
    assert composed("train", "model=hull").recalibration.k == 16


@pytest.mark.parametrize(("skip", "ablation"), [*((skip, "full") for skip in PRESETS), ("exact", "neither")])
def test_order_of_later_views_does_not_matter(skip, ablation):
    """The order of all views but the first, which the encoder treats differently, must not change the
    Gaussians."""
    batch = make_batch(1, 4, zoom=0.6)
    order = torch.tensor([0, 3, 1, 2])
    swapped = Batch(batch.images[:, order], batch.masks[:, order], batch.cameras[:, order])
    # On the image plane the order of views breaks ties at the largest distance: keep all neighbours.
    model = make_model(f"skip={skip}", f"ablation={ablation}", "recalibration.k=1000").double()
    with torch.no_grad():
        a, b = (predict(model, in_dtype(x, torch.float64)).gaussians for x in (batch, swapped))
    parts = [(b.image == i).nonzero()[:, 0] for i in (0, 2, 3, 1)]
    close(a, b.select(torch.cat(parts), b.splits), 2e-5)


def test_a_missing_stage_and_a_bad_value_name_their_key():
    """Configuration errors start with the key."""
    with pytest.raises(InputError, match="gaussian_head: expected a stage"):
        GHGS.from_config({k: v for k, v in config().items() if k != "gaussian_head"})
    with pytest.raises(InputError, match=r"depth_head\.parameterization: expected one of bounded_inverse"):
        GHGS.from_config(config("depth_head.parameterization=sphere"))
    with pytest.raises(InputError, match="recalibration"):
        GHGS.from_config(config("+recalibration.neighbours=3"))


@pytest.mark.parametrize(
    ("overrides", "found"),
    [
        (["model=paper", "bounds.kind=none"], "NoBounds with a depth head between bounds"),
        (["model=hull", "depth_head.parameterization=inverse_linear"], "consistency_depths"),
        (
            ["model=paper", "depth_head.parameterization=inverse_linear"],
            "SubjectBox with a depth head without bounds",
        ),
        (
            ["model=hull", "compat=release", "encoder.bounds_input=true"],
            "encoder.bounds_input: expected false",
        ),
    ],
)
def test_bounds_that_do_not_fit_the_depths_are_refused(overrides, found):
    """Missing bounds would otherwise fail in the first forward pass."""
    with pytest.raises(InputError, match=found):
        GHGS.from_config(config(*overrides))


def test_an_unknown_precision_is_refused_when_it_is_set():
    """A typing error is reported before the first forward pass."""
    model = make_model("model=paper")
    with pytest.raises(InputError, match="precision: expected one of inherit"):
        Predictor(model, precision="half")


def test_importing_the_package_does_not_import_torch():
    """`ghgs --help` must not wait for PyTorch."""
    code = (
        "import sys, ghgs_lit; assert 'torch' not in sys.modules; from ghgs_lit import GHGS, Batch, Gaussians"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert ghgs_lit.GHGS is GHGS
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = ghgs_lit.nothing


def test_skip_fast_gives_the_gaussians_of_skip_exact_where_nothing_is_background():
    """The preset changes only the tokens of the encoder."""
    batch = make_batch(2, 3)
    batch = dataclasses.replace(batch, masks=torch.ones_like(batch.masks))
    with torch.no_grad():
        fast, exact = (predict(make_model(f"skip={skip}"), batch).gaussians for skip in ("fast", "exact"))
    close(fast, exact)


def test_only_windows_around_the_subject_are_decoded():
    """skip=exact skips this work, except where all tokens require a depth."""
    batch = make_batch(2, 3, zoom=0.4)
    batch.masks[1, 0] = False
    model = make_model("skip=exact")
    decoded = []
    for head in (model.depth_head.dpt, model.gaussian_head.decoder):
        head.register_forward_hook(lambda _, args, maps: decoded.append((len(maps), *maps.shape[2:])))
    predict(model, batch)
    assert [count for count, *_ in decoded] == [3, 2, 3, 2]
    assert all(max(size) < 56 for _, *size in decoded)
    decoded.clear()
    model.recalibration.tokens = "all"
    predict(model, batch)
    assert decoded == [(6, 56, 56), *decoded[1:]]
    assert [count for count, *_ in decoded[1:]] == [3, 2]


@pytest.mark.parametrize(
    "overrides", [["model=hull"], ["unprojection.tokens=release"]], ids=operator.itemgetter(0)
)
@pytest.mark.parametrize("size", [(70, 70), (154, 98)])
def test_skip_exact_gives_the_gaussians_of_skip_none(size, overrides):
    """skip=exact promises the same Gaussians, also where windows are smaller than the images."""
    batch = make_batch(2, 3, *size, zoom=0.3)
    batch.masks[0, 1] = False
    batch.masks[1, 2, :5, -9:] = True
    with torch.no_grad():
        exact, none = (
            predict(make_model(f"skip={skip}", *overrides), batch).gaussians for skip in ("exact", "none")
        )
    close(exact, none)


@pytest.mark.parametrize("size", [(56, 56), (42, 70)])
def test_tokens_of_windows_give_gaussians_of_the_same_pixels(size):
    """The encoder receives less background; the geometry is that of the whole images."""
    batch = make_batch(2, 3, *size, zoom=0.5)
    whole, part = (predict(make_model(f"skip={name}"), batch) for name in ("exact", "balanced"))
    assert len(part.points.tokens) < len(whole.points.tokens)
    assert part.depth.shape == whole.depth.shape
    assert torch.equal(part.depth_valid, batch.masks)
    for name in ("image", "pixel", "colors"):
        assert torch.equal(getattr(part.gaussians, name), getattr(whole.gaussians, name)), name
    assert part.gaussians.splits == whole.gaussians.splits
    for name in ("near", "far"):
        near = (getattr(prediction.depth_maps.bounds, name)[batch.masks] for prediction in (part, whole))
        assert torch.equal(*near)
