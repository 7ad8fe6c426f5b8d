"""Encoder and dense head against numbers of the published architecture (random weights, CPU).

``fixtures/<case>.safetensors`` contains ``state/``, ``in/``, ``out/`` (float32) and ``out64/``
(float64, except for tables that are float32 here, too); ``encoder_cases.json`` contains options and
float32 bounds.
"""

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from ghgs_lit.method.encoder.block import REGISTERS, rotary_tables, rotate
from ghgs_lit.method.encoder.vit import VisionTransformer
from ghgs_lit.method.heads.dpt import DPTHead, add_positions_
from ghgs_lit.method.plan.patches import KeptPatches
from ghgs_lit.ops.activation import confidence_of
from ghgs_lit.types import Tokens
from tests.helpers.encoders import make_encoder

FIXTURES = Path(__file__).parents[2] / "fixtures"
CASES = json.loads((FIXTURES / "encoder_cases.json").read_text())
DTYPES = {torch.float32: "out", torch.float64: "out64"}


def _load(name: str) -> dict[str, dict[str, torch.Tensor]]:
    groups: dict[str, dict[str, torch.Tensor]] = {}
    for key, value in load_file(FIXTURES / f"{name}.safetensors").items():
        group, key = key.split("/", 1)
        groups.setdefault(group, {})[key] = value
    if "state" in CASES[name]:
        groups["state"] = _load(CASES[name]["state"])["state"]
    return groups


def _inputs(groups: dict, dtype: torch.dtype) -> dict[str, torch.Tensor]:
    return {k: v.to(dtype) if v.is_floating_point() else v for k, v in groups["in"].items()}


def _options(name: str) -> dict:
    options = {**CASES[name]["options"]}
    assert options.pop("registers") == REGISTERS
    return options


def _compare(name: str, groups: dict, dtype: torch.dtype, found: dict[str, torch.Tensor]) -> None:
    expected = groups[DTYPES[dtype]]
    assert set(found) == set(expected)
    # Position tables of another size are interpolated in float32, even for float64: each entry is a sum
    # whose order depends on the processor, and so do tokens.
    is_interpolated = "interp" in name or "same_count" in name
    share = 4 * torch.finfo(torch.float32).eps if is_interpolated else 1e-9
    for key, value in found.items():
        assert value.dtype == expected[key].dtype
        error = (value.reshape(expected[key].shape) - expected[key]).abs().max().item()
        largest = expected[key].abs().max().item()
        bound = CASES[name]["bounds"][key] if dtype == torch.float32 else share * largest
        assert error <= bound, f"{name}/{key}: {error:.3g} > {bound:.3g}"


def _names(prefix: str) -> list[str]:
    return [name for name in CASES if name.startswith(prefix)]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", _names("vit_"))
def test_vit(name, dtype):
    """The DINOv2 ViT reproduces the numbers of the published architecture."""
    groups = _load(name)
    vit = VisionTransformer(3, patch_size=14, **_options(name))
    vit.load_state_dict(groups["state"])
    vit.to(dtype)
    with torch.no_grad():
        x = _inputs(groups, dtype)["x"]
        n, _, height, width = x.shape
        kept = KeptPatches(torch.ones(1, n, height // 14, width // 14, dtype=torch.bool), x.device)
        tokens, patches = (rows.unflatten(0, (n, -1)) for rows in (vit.tokens(x, kept), vit(x, kept)))
    found = {"cls_token": tokens[:, 0], "register_tokens": tokens[:, 1:5], "patch_tokens": patches}
    _compare(name, groups, dtype, found)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", _names("agg_"))
def test_encoder(name, dtype):
    """The aggregator reproduces the published numbers, and the encoder reads out the right tokens."""
    groups = _load(name)
    encoder = make_encoder(**_options(name))
    encoder.aggregator.load_state_dict(groups["state"])
    encoder.to(dtype)
    images = _inputs(groups, dtype)["images"]
    b, v, _, height, width = images.shape
    with torch.no_grad():
        kept = KeptPatches(torch.ones(b, v, height // 14, width // 14, dtype=torch.bool), images.device)
        pairs, patches = encoder.aggregator((images - encoder.mean) / encoder.std, kept)
        tokens = encoder(images, torch.ones(b, v, height, width, dtype=torch.bool))
    found = {f"layer_{i}": torch.cat(pair, dim=-1).unflatten(0, (b * v, -1)) for i, pair in enumerate(pairs)}
    _compare(name, groups, dtype, found | {"patch_tokens": patches.unflatten(0, (b * v, -1))})

    assert tokens.grid == (b, v, height // 14, width // 14)
    assert torch.equal(tokens.semantic, patches)
    for i, latent in enumerate(tokens.latent):
        assert torch.equal(latent, found[f"layer_{i}"][:, 5:].flatten(0, 1))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", _names("rope_"))
def test_rotary_positions(name, dtype):
    """Rotary position embedding reproduces the published numbers."""
    groups = _load(name)
    inputs = _inputs(groups, dtype)
    assert (inputs["positions"] == inputs["positions"][:1]).all()
    tables = rotary_tables(inputs["positions"][0], inputs["x"].shape[-1], inputs["x"])
    _compare(name, groups, dtype, {"rotated": rotate(inputs["x"], tables)})


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", ["dpt_depth_tall", "dpt_features_nonsquare", "dpt_small_variance"])
def test_dpt(name, dtype):
    """The DPT head reproduces the published numbers."""
    case, groups = CASES[name], _load(name)
    options = case["options"]
    widths = options["features"], tuple(options["out_channels"])
    head = DPTHead(options["dim_in"], options["output_dim"], widths=widths)
    head.load_state_dict(groups["state"])
    head.to(dtype)
    inputs = _inputs(groups, dtype)
    b, v, _, height, width = inputs["images"].shape
    grid = (b, v, height // 14, width // 14)
    packed = [inputs[f"tokens_{i}"][:, :, case["special"] :].flatten(0, 2) for i in range(4)]
    index = torch.zeros(len(packed[0]), dtype=torch.long)
    tokens = Tokens(tuple(packed), packed[0], index, index, index, grid, 14)
    with torch.no_grad():
        raw = head(tokens)
    assert raw.shape == (b * v, case["options"]["output_dim"], height, width)
    if "activations" not in case:
        return _compare(name, groups, dtype, {"features": raw})
    assert case["activations"] == ["linear", "expp1"]
    channels = raw.movedim(1, -1)
    found = {"preds": channels[..., :-1], "conf": confidence_of(channels[..., -1])}
    _compare(name, groups, dtype, found)


@pytest.mark.parametrize("dtype", DTYPES)
def test_dpt_positions(dtype):
    """The DPT head's position embedding reproduces the published numbers."""
    name = "dpt_posembed"
    groups = _load(name)
    like = _inputs(groups, dtype)["like"]
    found = {
        f"embed_{i}": add_positions_(like.new_zeros(1, channels, rows, columns), width / height)[0]
        for i, (channels, rows, columns, height, width) in enumerate(CASES[name]["cases"])
    }
    expected = groups[DTYPES[dtype]]
    _compare(name, groups, dtype, {key: value.to(expected[key].dtype) for key, value in found.items()})
