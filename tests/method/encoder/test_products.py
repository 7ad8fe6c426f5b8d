"""The fast paths on a CPU against plain PyTorch, half precision, and invariants."""

import pytest
import torch
import torch.nn.functional as F

import ghgs_lit.ops.linear
from ghgs_lit.errors import InputError
from ghgs_lit.execution import Predictor
from ghgs_lit.geometry.precision import has_bfloat16, precision_of
from ghgs_lit.method.encoder.block import Block, rotary_tables
from ghgs_lit.method.plan.patches import KeptPatches
from ghgs_lit.ops.attention import cpu
from ghgs_lit.ops.compile import processor_features
from ghgs_lit.ops.linear import linear
from ghgs_lit.ops.pool import even_parts
from tests.helpers.encoders import make_encoder
from tests.helpers.models import ATTRIBUTES, make_model
from tests.helpers.scenes import make_batch

CPU = torch.device("cpu")


@pytest.fixture
def convolutions(monkeypatch):
    """Compute products of any size by oneDNN, with a gradient as convolutions, on any machine."""
    monkeypatch.setattr(ghgs_lit.ops.linear, "_WIDE_PRODUCTS", True)
    for limit in ("_SMALL", "_LARGE", "_PIXELS"):
        monkeypatch.setattr(ghgs_lit.ops.linear, limit, 0)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)


@pytest.fixture
def kernels(monkeypatch):
    """Use the attention kernel for any size, even where the processor lacks features that make it fast."""
    features = processor_features() | {"avx2", "fma"}
    for limit in ("_SMALL", "_LARGE"):
        monkeypatch.setattr(f"ghgs_lit.ops.attention.{limit}", 0)
    monkeypatch.setattr("ghgs_lit.ops.pool.features", lambda: features)
    calls, attend = [], cpu.attend_heads
    monkeypatch.setattr(cpu, "attend_heads", lambda *args: calls.append(1) or attend(*args))
    yield
    assert calls


@pytest.mark.parametrize("shape", [(7, 12), (2, 5, 12), (2, 3, 4, 12), (1, 12)])
@pytest.mark.parametrize("bias", [False, True])
def test_product_is_the_linear_layer(convolutions, monkeypatch, shape, bias):
    """A product computed as a convolution equals the linear layer in values and gradients; so does one
    without a gradient."""
    g = torch.Generator().manual_seed(0)
    x, weight, b = (torch.randn(s, generator=g, requires_grad=True) for s in (shape, (9, 12), (9,)))
    with torch.no_grad():
        columns_first = x.mT.contiguous().mT
        without = linear(columns_first, weight, b if bias else None)
    calls, convolve = [], F.conv2d
    monkeypatch.setattr(F, "conv2d", lambda *args: calls.append(1) or convolve(*args))
    found, expected = (f(x, weight, b if bias else None) for f in (linear, F.linear))
    assert calls == [1]
    assert found.is_contiguous()
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(without, expected.detach())
    inputs = [x, weight, *[b] * bias]
    upstream = torch.randn(expected.shape, generator=g)
    for mine, own in zip(*(torch.autograd.grad(y, inputs, upstream) for y in (found, expected)), strict=True):
        torch.testing.assert_close(mine, own)


def test_which_products_are_onednns(monkeypatch):
    """On processors with wide vectors, all but tiny products, in float32; in training with two threads or
    more."""
    monkeypatch.setattr(ghgs_lit.ops.linear, "_WIDE_PRODUCTS", True)
    threads, x, weight = torch.get_num_threads(), torch.empty(1000, 512), torch.empty(64, 512)
    prefers = ghgs_lit.ops.linear.prefers_onednn
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            assert prefers(x, weight) == (count > 1)
            with torch.no_grad():
                assert prefers(x, weight)
                assert not prefers(x[:10], weight)
                assert not prefers(x.double(), weight.double())
                assert not prefers(x.to("meta"), weight.to("meta"))
                with torch.autocast("cpu", torch.bfloat16):
                    assert not prefers(x, weight)
    finally:
        torch.set_num_threads(threads)
    monkeypatch.setattr(ghgs_lit.ops.linear, "_WIDE_PRODUCTS", False)
    with torch.no_grad():
        assert not prefers(x, weight)


@pytest.mark.parametrize(("rows", "calls"), [(11, 5), (12, 1), (40, 1)])
def test_weights_of_products_of_few_rows_are_copied_in_parts(convolutions, monkeypatch, rows, calls):
    """Large weights with few rows are split, so that oneDNN's copy does not fill the memory."""
    monkeypatch.setattr(ghgs_lit.ops.linear, "_COPY", 24)
    g = torch.Generator().manual_seed(0)
    x, weight, b = (torch.randn(s, generator=g) for s in ((rows, 12), (9, 12), (9,)))
    seen, convolve = [], F.conv2d
    monkeypatch.setattr(F, "conv2d", lambda *args: seen.append(1) or convolve(*args))
    torch.testing.assert_close(linear(x, weight, b), F.linear(x, weight, b))
    assert len(seen) == calls


def test_even_parts_cover_all_rows():
    """Parts cover every row once, respect the size limit and differ by at most one row."""
    for count in (0, 1, 5, 16, 17):
        for most in (0, 1, 4, 100):
            parts = even_parts(count, most)
            rows = [i for part in parts for i in range(count)[part]]
            assert rows == list(range(count))
            sizes = {part.stop - part.start for part in parts}
            assert max(sizes) - min(sizes) <= 1
            assert max(sizes) <= max(1, most)


@pytest.mark.parametrize("qk_norm", [False, True])
def test_a_block_without_gradient_is_the_same_and_keeps_its_input(
    convolutions, kernels, monkeypatch, qk_norm
):
    """The in-place path without a gradient gives the same result and does not overwrite its input."""
    monkeypatch.setattr("ghgs_lit.method.encoder.block._HIDDEN", 200)
    torch.manual_seed(0)
    block = Block(64, 2, qk_norm, 1e-5, 0.5)
    with torch.no_grad():
        for parameter in block.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape))
    kept = KeptPatches(torch.ones(1, 3, 2, 3, dtype=torch.bool), torch.device("cpu"))
    rotary = rotary_tables(kept.positions(special=5), 32, torch.zeros(1)) if qk_norm else None
    x, lengths = torch.randn(3 * 11, 64), [11] * 3
    before = x.clone()
    with torch.no_grad():
        found = block(x, lengths, rotary)
    assert torch.equal(x, before)  # the input is not written to
    torch.testing.assert_close(found, block(x, lengths, rotary).detach(), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("tokens", ["all", "subject"])
def test_the_whole_encoder_is_the_same_without_a_gradient(convolutions, kernels, tokens):
    """All fast paths together do not change the encoder's tokens, for views with any number of tokens."""
    torch.manual_seed(0)
    vit = {"kind": "dinov2", "depth": 2, "heads": 2}
    options = {"image_size": 28, "layer_scale": 0.5, "tokens": tokens, "margin": 0}
    encoder = make_encoder(width=64, heads=2, depth=3, layers=(0, 1, 2), vit=vit, **options)
    images, masks = torch.rand(2, 3, 3, 28, 42), torch.ones(2, 3, 28, 42, dtype=torch.bool)
    masks[0, 1, :, 14:] = masks[1, 2] = False
    expected = encoder(images, masks)
    with torch.no_grad():
        found = encoder(images, masks)
    torch.testing.assert_close(found.semantic, expected.semantic, atol=1e-4, rtol=1e-4)
    for mine, own in zip(found.latent, expected.latent, strict=True):
        torch.testing.assert_close(mine, own.detach(), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(("trainable", "recorded"), [("none", 0), ("last_1", 2), ("all", 4)])
def test_frozen_blocks_record_no_gradient(monkeypatch, trainable, recorded):
    """Frozen blocks keep no activations, which would cost memory in training."""
    seen = []
    forward = Block.forward

    def spy(block, *arguments):
        seen.append(torch.is_grad_enabled())
        return forward(block, *arguments)

    monkeypatch.setattr(Block, "forward", spy)
    encoder = make_encoder(
        width=32, heads=2, depth=2, layers=(0, 1), vit={"kind": "conv"}, trainable=trainable
    )
    encoder(torch.rand(1, 2, 3, 28, 28), torch.ones(1, 2, 28, 28, dtype=torch.bool))
    assert seen == [False] * (4 - recorded) + [True] * recorded


@pytest.mark.parametrize("model", ["paper", "hull", "recurrent"])
def test_predictions_in_bfloat16_stay_near_and_geometry_is_float32(model):
    """Half precision changes predictions little and never rounds geometry."""
    module = make_model(f"model={model}").eval()
    batch = make_batch(height=140, width=112, views=3)
    with torch.no_grad():
        exact = module(batch)
        with torch.autocast("cpu", torch.bfloat16):
            low = module(batch)
    for tensor in (
        low.depth,
        low.points.pixels,
        low.points.tokens,
        *(getattr(low.gaussians, a) for a in ATTRIBUTES),
    ):
        assert tensor.dtype == torch.float32
        assert tensor.isfinite().all()
    valid = exact.depth_valid
    # Depths are not rounded to bfloat16, whose steps at 2 m are 16 mm.
    assert len(low.depth[valid].unique()) > valid.sum() // 2
    assert (low.depth - exact.depth)[valid].abs().median() < 0.02


def test_training_under_autocast_gives_float32_gradients():
    """Mixed-precision training gives finite float32 gradients."""
    module = make_model("model=paper")
    batch = make_batch(height=56, width=56, views=2)
    with torch.autocast("cpu", torch.bfloat16):
        gaussians = module(batch).gaussians
    sum(getattr(gaussians, a).square().mean() for a in ATTRIBUTES).backward()
    gradients = [p.grad for p in module.parameters() if p.grad is not None]
    assert gradients
    assert all(g.dtype == torch.float32 and g.isfinite().all() for g in gradients)


def test_precision_is_what_the_model_is_told(monkeypatch):
    """The model's precision setting overrides the caller's autocast."""
    monkeypatch.setattr("ghgs_lit.geometry.precision.has_bfloat16", lambda _: True)
    module = Predictor(make_model("model=paper").eval())
    batch = make_batch(height=56, width=56, views=2)
    with torch.no_grad():
        exact = module(batch).depth
        with torch.autocast("cpu", torch.bfloat16):
            inherited = module(batch).depth
            module.precision = "float32"
            assert torch.equal(module(batch).depth, exact)
        for name in ("bfloat16", "auto"):
            module.precision = name
            assert torch.equal(module(batch).depth, inherited)
    assert not torch.equal(inherited, exact)


def test_precision_that_a_device_lacks_is_refused(monkeypatch):
    """A precision that a device lacks is an error, not a slow emulation."""
    monkeypatch.setattr(
        "torch.cpu.get_capabilities", lambda: {"avx512_bf16": False, "architecture": "x86_64"}
    )
    assert not has_bfloat16(CPU)
    with pytest.raises(InputError, match="precision: expected float32 on a device without bfloat16"):
        precision_of("bfloat16", CPU)
    with precision_of("auto", CPU):
        assert not torch.is_autocast_enabled("cpu")
    with pytest.raises(InputError, match="precision: expected float16 on CUDA only; found 'cpu'"):
        precision_of("float16", CPU)
    with pytest.raises(InputError, match="precision: expected one of"):
        precision_of("half", CPU)
    monkeypatch.setattr("torch.cpu.get_capabilities", lambda: {"amx_bf16": True})
    assert has_bfloat16(CPU)


def test_checkpointing_keeps_fewer_bytes_and_the_same_gradients():
    """Recomputing activations saves memory, with bit-identical gradients."""
    found = {}
    for checkpointing in (False, True):
        torch.manual_seed(0)
        vit = {"kind": "dinov2", "depth": 3, "heads": 2}
        encoder = make_encoder(
            width=32, heads=2, depth=4, layers=(1, 3), vit=vit, image_size=56, checkpointing=checkpointing
        )
        kept = []

        def pack(tensor, kept=kept):
            kept.append(tensor.numel())
            return tensor

        images = torch.rand(1, 3, 3, 56, 56, generator=torch.Generator().manual_seed(1))
        with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
            tokens = encoder(images, torch.ones(1, 3, 56, 56, dtype=torch.bool))
        count = sum(kept)
        sum(layer.square().mean() for layer in tokens.latent).backward()
        found[checkpointing] = count, [p.grad for p in encoder.parameters() if p.requires_grad]
    assert found[True][0] < 0.25 * found[False][0]
    for plain, recomputed in zip(found[False][1], found[True][1], strict=True):
        assert torch.equal(plain, recomputed)


def test_tokens_in_half_precision_weights_pass_the_fast_path(convolutions, kernels):
    """An encoder with bfloat16 weights uses the kernels and stays close to float32."""
    torch.manual_seed(0)
    encoder = make_encoder(width=64, heads=2, depth=2, layers=(0, 1), vit={"kind": "conv"}, layer_scale=0.5)
    images, masks = torch.rand(1, 2, 3, 56, 56), torch.ones(1, 2, 56, 56, dtype=torch.bool)
    with torch.no_grad():
        exact = encoder(images, masks).latent[1]
        low = encoder.bfloat16()(images, masks).latent[1]
    assert low.dtype == torch.bfloat16
    assert (low - exact).square().mean().sqrt() < 0.02 * exact.std()
    with_gradient = encoder(images, masks).latent[1]
    assert with_gradient.dtype == torch.bfloat16
    assert with_gradient.isfinite().all()
