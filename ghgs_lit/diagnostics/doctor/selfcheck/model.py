"""Each stage of the model on the device, in each precision, against the CPU in float64."""

import dataclasses
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from ghgs_lit.diagnostics.benchmark.error import ATTRIBUTES
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.diagnostics.benchmark.weights import random_model
from ghgs_lit.diagnostics.doctor.selfcheck.outcome import SKIPPED, Outcome, compared
from ghgs_lit.kernels.precision import has_bfloat16
from ghgs_lit.kernels.watching import Results, watched
from ghgs_lit.model import GHGS
from ghgs_lit.types import Batch, Gaussians

#: Largest error of a stage, by precision. In float32 it is 1e-6 on a CPU; a device that sums in another order
#: may choose another neighbour at equal distances, which moves one token. The others round every product: 8
#: times the rounding of one (2^-8 in bfloat16, 2^-11 in float16 and TF32); in bfloat16 a CPU has 1.6 times.
LIMITS = {"float32": 1e-4, "tf32": 2.0**-8, "bfloat16": 2.0**-5, "float16": 2.0**-8}
#: Of the gradient of all weights in float32. It jumps where rounding takes a unit across 0 or a token to
#: another neighbour: 2e-6 to 2e-3 on a CPU.
GRADIENT_LIMIT = 1e-2


def stages(config: Mapping[str, Any], device: torch.device) -> Iterator[Outcome]:
    """Of each precision that the device has: the first stage that fails is the one to look at."""
    batch = small_batch(config)
    expected = _results(random_model(config).double(), in_float64(batch))
    for precision, limit in LIMITS.items():
        reason = _unsupported(precision, device)
        if reason is not None:
            yield Outcome(f"model, {precision}", SKIPPED, reason)
            continue
        model = random_model(config).to(device)
        model.precision = "float32" if precision == "tf32" else precision
        with _products(tf32=precision == "tf32"):
            found = _results(model, batch.to(device))
        for stage, value in expected.items():
            # Geometry is float32 in every precision.
            allowed = LIMITS["float32"] if stage == "bounds" else limit
            yield compared(f"model, {precision}: {stage}", found[stage], value, allowed)


def gradient(config: Mapping[str, Any], device: torch.device) -> Iterator[Outcome]:
    """Of all weights, in float32."""
    batch = small_batch(config)
    expected = gradients(random_model(config).double(), in_float64(batch))
    with _products(tf32=False):
        found = gradients(random_model(config).to(device), batch.to(device))
    yield compared("gradient of the weights, float32", found, expected, GRADIENT_LIMIT)


def small_batch(config: Mapping[str, Any]) -> Batch:
    """Two elements of three views of four by four patches, without targets."""
    batch = ellipsoid_batch(0.15, 3, 4 * config["encoder"]["patch_size"], 2)
    return dataclasses.replace(batch, targets=None)


def in_float64(batch: Batch) -> Batch:
    """The same numbers in float64."""
    return dataclasses.replace(batch, images=batch.images.double(), cameras=batch.cameras.to(torch.float64))


def score(gaussians: Gaussians) -> Tensor:
    """One number that depends on all attributes."""
    return sum(_waves(getattr(gaussians, name)).mean() for name in ATTRIBUTES)


def gradients(model: GHGS, batch: Batch) -> Tensor:
    """Of :func:`score`, of all weights in one row."""
    score(model.requires_grad_(True)(batch).gaussians).backward()
    return gradient_row(model)


def gradient_row(module: nn.Module) -> Tensor:
    """The gradients of all weights, in float64 on the CPU; 0 where a weight has none."""
    rows = [torch.zeros_like(p) if p.grad is None else p.grad for p in module.parameters()]
    return torch.cat([row.cpu().double().flatten() for row in rows])


def _waves(values: Tensor) -> Tensor:
    """Values with different signs and weights: the sum of squares of a unit quaternion says nothing."""
    weights = torch.arange(values.numel(), device=values.device, dtype=torch.float32).cos()
    return values * weights.view_as(values).to(values.dtype)


@contextmanager
def _products(tf32: bool) -> Iterator[None]:
    """Products of float32 numbers on CUDA rounded to TF32, or not; convolutions are by PyTorch's default."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if tf32 else "highest")
    try:
        with torch.backends.cudnn.flags(allow_tf32=tf32):
            yield
    finally:
        torch.set_float32_matmul_precision(before)


def _unsupported(precision: str, device: torch.device) -> str | None:
    if precision in ("float16", "tf32") and device.type != "cuda":
        return f"{precision} runs on CUDA only, not on {device.type}"
    if precision == "bfloat16" and not has_bfloat16(device):
        return f"{device.type} has no bfloat16 instructions here"
    return None


@torch.no_grad()
def _results(model: GHGS, batch: Batch) -> dict[str, Tensor]:
    """What each stage gives for the subject, in the order of the data flow, on the CPU."""
    seen = Results()
    with watched(model, {name: name for name in ("encoder", "recalibration")}, seen):
        prediction = model(batch).to("cpu")
    encoder, recalibration = (torch.stack(tokens.latent).cpu() for tokens in seen.results.values())
    bounds, points, masks = prediction.depth_maps.bounds, prediction.points, batch.masks.cpu()
    edges = {} if bounds is None else {"bounds": torch.stack((bounds.near[masks], bounds.far[masks]))}
    return {
        **edges,
        "encoder": encoder,
        "depth_head": prediction.depth[masks],
        "unprojection": points.tokens[points.tokens_valid],
        "recalibration": recalibration,
        **{f"gaussian_head, {name}": getattr(prediction.gaussians, name) for name in ATTRIBUTES},
    }
