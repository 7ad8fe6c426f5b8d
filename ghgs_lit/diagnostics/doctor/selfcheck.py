"""Whether a device computes as the CPU does in float64: renderer, stages, gradient of all weights."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ghgs_lit.diagnostics.benchmark.measure import ATTRIBUTES
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch, random_model
from ghgs_lit.errors import InputError
from ghgs_lit.kernels.precision import has_bfloat16
from ghgs_lit.kernels.watching import Results, watched
from ghgs_lit.model import GHGS
from ghgs_lit.rendering import RasterSettings, render
from ghgs_lit.rendering.api import resolve_backend
from ghgs_lit.types import Batch, Cameras, Gaussians

PASSED, FAILED, SKIPPED = "pass", "fail", "skip"
#: Largest errors of images and of their gradients. Rounding to float32 gives 1e-6 and 1e-5 on a CPU; a splat
#: that one of both cuts off at 1/255, at its border of a tile or in another order gives more than 1e-3.
IMAGE_LIMIT, IMAGE_GRADIENT_LIMIT = 1e-4, 1e-3
#: Largest error of a stage, by precision. In float32 it is 1e-6 on a CPU; a device that sums in another order
#: may choose another neighbour at equal distances, which moves one token. The others round every product: 8
#: times the rounding of one (2^-8 in bfloat16, 2^-11 in float16 and TF32); in bfloat16 a CPU has 1.6 times.
LIMITS = {"float32": 1e-4, "tf32": 2.0**-8, "bfloat16": 2.0**-5, "float16": 2.0**-8}
#: Of the gradient of all weights in float32. It jumps where rounding takes a unit across 0 or a token to
#: another neighbour: 2e-6 to 4e-2 on a CPU. Of three models one at least is spared; a wrong kernel spares
#: none.
GRADIENT_LIMIT, _MODELS = 1e-2, 3
_SIZE, _LONGEST = 48, 300  #: Side of the photographs of splats, and characters of an error that are shown


@dataclass(frozen=True)
class Outcome:
    """One row: what was checked, one of the three statuses, and what was found or why it was skipped."""

    check: str
    status: str
    found: str


def selfcheck(config: Mapping[str, Any], device: torch.device) -> Iterator[Outcome]:
    """All checks, each outcome as soon as it is known; an error ends its check alone, and is an outcome.
    ``config``: of a run of ``ghgs train``; its model gets random weights. ``device``: what is compared with
    the CPU."""
    for check in CHECKS:
        try:
            yield from check(config, device)
        except Exception as error:
            text = " ".join(f"{type(error).__name__}: {error}".split())
            yield Outcome(check.__name__, FAILED, text[:_LONGEST])


def table(outcomes: Sequence[Outcome]) -> str:
    """The outcomes as Markdown."""
    rows = [f"| {o.check} | {o.status} | {o.found.replace('|', '/')} |" for o in outcomes]
    return "\n".join(["| check | status | found |", "|---|---|---|", *rows])


def compared(check: str, found: Tensor, expected: Tensor, limit: float) -> Outcome:
    """Passes where the norm of the difference is at most ``limit`` of that of ``expected``, in one shape."""
    error = float("nan")
    if found.shape == expected.shape:
        found, expected = found.detach().cpu().double(), expected.detach().cpu().double()
        norm = expected.norm()
        error = float((found - expected).norm() / torch.where(norm > 0, norm, 1.0))
    # Written so that NaN fails.
    return Outcome(check, PASSED if error <= limit else FAILED, f"error {error:.1e}, limit {limit:.0e}")


def renderer(config: Mapping[str, Any], device: torch.device) -> Iterator[Outcome]:
    """Of random splats with and without antialiasing, and of splats around each threshold: the reference's
    images and gradients."""
    backend = config["renderer"]["backend"]
    try:
        backend = resolve_backend(backend, device)
    except InputError as error:
        yield Outcome(f"renderer {backend}", SKIPPED, str(error))
        return
    cameras = ellipsoid_batch(0.15, 2, _SIZE, 2).cameras
    for name, splats, settings in (
        ("random splats", _random_splats(), RasterSettings()),
        ("antialiased", _random_splats(), RasterSettings(antialiased=True)),
        ("thresholds", _splats_at_thresholds(cameras), RasterSettings()),
    ):
        found = _rendered(splats, cameras, settings, backend, device, torch.float32)
        expected = _rendered(splats, cameras, settings, "reference", torch.device("cpu"), torch.float64)
        for part, value in expected.items():
            limit = IMAGE_GRADIENT_LIMIT if part.startswith("gradient") else IMAGE_LIMIT
            yield compared(f"renderer {backend}, {name}: {part}", found[part], value, limit)


def _random_splats() -> Gaussians:
    """Of two elements with different numbers of splats, about as large as a person."""
    n, g = 240, torch.Generator().manual_seed(0)
    return Gaussians(
        means=torch.randn(n, 3, generator=g) * torch.tensor([0.2, 0.5, 0.2]),
        quaternions=torch.randn(n, 4, generator=g),
        scales=0.01 + 0.05 * torch.rand(n, 3, generator=g),
        opacities=0.1 + 0.8 * torch.rand(n, generator=g),
        colors=torch.rand(n, 3, generator=g),
        splits=(150, 90),
    )


def _splats_at_thresholds(cameras: Cameras) -> Gaussians:
    """Before the first camera of each element: opacities just below and above 1/255; ten opaque splats behind
    one another, whose light ends before the last; a bright one nearer than ``near``, one behind."""
    depths = [2.0, 2.0, *(2.2 + 0.05 * i for i in range(10)), 0.005, -1.0]
    opacities = [0.9 / 255, 1.2 / 255, *[0.9, 1.0] * 5, 1.0, 1.0]
    right = [-0.4, 0.4, *[0.02 * i for i in range(10)], 0.0, 0.0]
    n = len(depths)
    place = torch.tensor([right, [0.01] * n, depths]).T
    means = [(place - c.extrinsics[:3, 3]) @ c.extrinsics[:3, :3] for c in (cameras[e, 0] for e in range(2))]
    return Gaussians(
        means=torch.cat(means),
        quaternions=torch.tensor([[0.9, 0.1, -0.3, 0.2]]).repeat(2 * n, 1),
        # Of three lengths: the direction of a ball has no gradient.
        scales=torch.tensor([[0.06, 0.1, 0.14]]).repeat(2 * n, 1),
        opacities=torch.tensor(opacities * 2),
        colors=torch.rand(2 * n, 3, generator=torch.Generator().manual_seed(0)),
        splits=(n, n),
    )


def _rendered(
    splats: Gaussians,
    cameras: Cameras,
    settings: RasterSettings,
    backend: str,
    device: torch.device,
    dtype: torch.dtype,
) -> dict[str, Tensor]:
    leaves = {n: getattr(splats, n).to(device, dtype, copy=True).requires_grad_() for n in ATTRIBUTES}
    found = render(Gaussians(**leaves, splits=splats.splits), cameras.to(device), backend, settings=settings)
    parts = {name: getattr(found, name) for name in ("image", "alpha", "depth")}
    sum(part.square().sum() for part in parts.values()).backward()
    return parts | {f"gradient of {name}": leaf.grad for name, leaf in leaves.items()}


def stages(config: Mapping[str, Any], device: torch.device) -> Iterator[Outcome]:
    """Each stage in each precision that the device has: the first one that fails is the one to look at."""
    batch = _small_batch(config)
    expected = _results(random_model(config).double(), _in_float64(batch))
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
    """Of all weights, in float32: the nearest of a few random models."""
    batch, outcomes = _small_batch(config), []
    for seed in range(_MODELS):
        expected = _gradients(random_model(config, seed).double(), _in_float64(batch))
        with _products(tf32=False):
            found = _gradients(random_model(config, seed).to(device), batch.to(device))
        outcomes.append(compared("gradient of the weights, float32", found, expected, GRADIENT_LIMIT))
        if outcomes[-1].status == PASSED:
            break
    yield outcomes[-1]


CHECKS = (renderer, stages, gradient)


def _small_batch(config: Mapping[str, Any]) -> Batch:
    """Two elements of three views of four by four patches, without targets."""
    batch = ellipsoid_batch(0.15, 3, 4 * config["encoder"]["patch_size"], 2)
    return replace(batch, targets=None)


def _in_float64(batch: Batch) -> Batch:
    return replace(batch, images=batch.images.double(), cameras=batch.cameras.to(torch.float64))


def _unsupported(precision: str, device: torch.device) -> str | None:
    if precision in ("float16", "tf32") and device.type != "cuda":
        return f"{precision} runs on CUDA only, not on {device.type}"
    if precision == "bfloat16" and not has_bfloat16(device):
        return f"{device.type} has no bfloat16 instructions here"
    return None


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


def _gradients(model: GHGS, batch: Batch) -> Tensor:
    """Of a number that depends on all attributes, of all weights in one row in float64 on the CPU."""
    gaussians = model.requires_grad_(True)(batch).gaussians
    sum(_waves(getattr(gaussians, name)).mean() for name in ATTRIBUTES).backward()
    rows = [torch.zeros_like(p) if p.grad is None else p.grad for p in model.parameters()]
    return torch.cat([row.cpu().double().flatten() for row in rows])


def _waves(values: Tensor) -> Tensor:
    """Values with different signs and weights: the sum of squares of a unit quaternion says nothing."""
    weights = torch.arange(values.numel(), device=values.device, dtype=torch.float32).cos()
    return values * weights.view_as(values).to(values.dtype)
