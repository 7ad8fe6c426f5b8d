"""Comparison of a device with the CPU in float64: renderer, stages, gradient of all weights."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ghgs_lit.config.run import Run
from ghgs_lit.diagnostics.benchmark.measure import ATTRIBUTES
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch, random_model
from ghgs_lit.errors import InputError
from ghgs_lit.execution import Predictor
from ghgs_lit.geometry.precision import exact, has_bfloat16, rounds_products
from ghgs_lit.method.model import GHGS
from ghgs_lit.rendering import RasterSettings, render
from ghgs_lit.rendering.api import resolve_backend
from ghgs_lit.runtime.watching import Results, watched
from ghgs_lit.types import Batch, Cameras, Gaussians

PASSED = "pass"
FAILED = "fail"
SKIPPED = "skip"
#: Largest errors of images and their gradients. Rounding to float32 gives 1e-6 and 1e-5 on a
#: CPU; a splat that is cut off at 1/255 or at a tile's border, or drawn in another order, gives
#: more than 1e-3.
IMAGE_LIMIT = 1e-4
IMAGE_GRADIENT_LIMIT = 1e-3
#: Largest error of a stage, by precision. In float32 it is 1e-6 on a CPU; with another order of
#: summation another of two equally distant neighbours may be chosen, which moves one token. The
#: other precisions round every product: 8 times one rounding (2^-8 in bfloat16, 2^-11 in float16
#: and TF32); 1.6 times in bfloat16 on a CPU.
LIMITS = {"float32": 1e-4, "tf32": 2.0**-8, "bfloat16": 2.0**-5, "float16": 2.0**-8}
#: What is checked: ``precision`` as of the verbs, in the order in which it is most used.
PRECISIONS = ("inherit", *LIMITS)
#: Largest error of the gradient of all weights in float32, and number of models that are tried. It
#: jumps if rounding moves a unit across 0 or a token to another neighbour: 2e-6 to 4e-2 on a CPU.
#: At least one of three models has no such jump; a wrong kernel affects all.
GRADIENT_LIMIT = 1e-2
_MODELS = 3
_SIZE = 48  #: Side of the images of splats, in pixels
_LONGEST = 300  #: Number of characters of an error that are shown


@dataclass(frozen=True)
class Outcome:
    """Outcome of a check.

    Attributes:
        check: what was compared.
        status: :data:`PASSED`, :data:`FAILED` or :data:`SKIPPED`.
        found: the error, or why the check was skipped.
    """

    check: str
    status: str
    found: str


def selfcheck(run: Run, device: torch.device) -> Iterator[Outcome]:
    """Compare a device with the CPU in float64. An error is an outcome and ends only its check.

    Args:
        run: as of ``ghgs train``, as plain data; its model gets random weights.
        device: what is checked.

    Yields:
        The outcomes of all checks.
    """
    for check in CHECKS:
        try:
            yield from check(run, device)
        except Exception as error:
            text = " ".join(f"{type(error).__name__}: {error}".split())
            yield Outcome(check.__name__, FAILED, text[:_LONGEST])


def table(outcomes: Sequence[Outcome]) -> str:
    """Outcomes as Markdown."""
    rows = [f"| {o.check} | {o.status} | {o.found.replace('|', '/')} |" for o in outcomes]
    return "\n".join(["| check | status | found |", "|---|---|---|", *rows])


def compared(check: str, found: Tensor, expected: Tensor, limit: float) -> Outcome:
    """Compare a tensor with the expected one by their 2-norms.

    Args:
        check: name of the check.
        found: any shape, on any device.
        expected: of the same shape, on any device.
        limit: largest ``|found - expected| / |expected|``, absolute where ``expected`` is 0.

    Returns:
        An outcome that passes if the shapes agree and the limit is kept; NaN fails.
    """
    error = float("nan")
    if found.shape == expected.shape:
        found = found.detach().cpu().double()
        expected = expected.detach().cpu().double()
        norm = expected.norm()
        error = float((found - expected).norm() / torch.where(norm > 0, norm, 1.0))
    # This comparison fails for NaN.
    return Outcome(check, PASSED if error <= limit else FAILED, f"error {error:.1e}, limit {limit:.0e}")


def renderer(run: Run, device: torch.device) -> Iterator[Outcome]:
    """Check images and gradients of splats: random, antialiased,
    and around the renderer's thresholds.

    Args:
        run: as of ``ghgs train``; names the renderer's backend.
        device: what is checked.

    Yields:
        An outcome for each image and gradient; one alone where the backend cannot run.
    """
    backend = run.renderer.backend
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
    n = 240
    g = torch.Generator().manual_seed(0)
    return Gaussians(
        means=torch.randn(n, 3, generator=g) * torch.tensor([0.2, 0.5, 0.2]),
        quaternions=torch.randn(n, 4, generator=g),
        scales=0.01 + 0.05 * torch.rand(n, 3, generator=g),
        opacities=0.1 + 0.8 * torch.rand(n, generator=g),
        colors=torch.rand(n, 3, generator=g),
        splits=(150, 90),
    )


def _splats_at_thresholds(cameras: Cameras) -> Gaussians:
    """Splats before the first camera of each element: opacities just below and above 1/255; ten
    opaque ones behind one another, which saturate before the last; one nearer than ``near``; one
    behind the camera."""
    depths = [2.0, 2.0, *(2.2 + 0.05 * i for i in range(10)), 0.005, -1.0]
    opacities = [0.9 / 255, 1.2 / 255, *[0.9, 1.0] * 5, 1.0, 1.0]
    right = [-0.4, 0.4, *[0.02 * i for i in range(10)], 0.0, 0.0]
    n = len(depths)
    place = torch.tensor([right, [0.01] * n, depths]).T
    means = []
    for element in range(2):
        extrinsics = cameras[element, 0].extrinsics
        means.append((place - extrinsics[:3, 3]) @ extrinsics[:3, :3])
    return Gaussians(
        means=torch.cat(means),
        quaternions=torch.tensor([[0.9, 0.1, -0.3, 0.2]]).repeat(2 * n, 1),
        # Three lengths: the rotation of a ball has no gradient.
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
    """Render splats, and differentiate the sum of all squared values.

    Args:
        splats: of n elements.
        cameras: [n, T].
        settings: of the rasterizer.
        backend: gsplat, cpu or reference.
        device: where it runs.
        dtype: of the splats.

    Returns:
        ``image``, ``alpha``, ``depth``, and ``gradient of <attribute>``.
    """
    leaves = {n: getattr(splats, n).to(device, dtype, copy=True).requires_grad_() for n in ATTRIBUTES}
    gaussians = Gaussians(**leaves, splits=splats.splits)
    rendering = render(gaussians, cameras.to(device), backend, settings=settings)
    parts = {name: getattr(rendering, name) for name in ("image", "alpha", "depth")}
    sum(part.square().sum() for part in parts.values()).backward()
    return parts | {f"gradient of {name}": leaf.grad for name, leaf in leaves.items()}


def stages(run: Run, device: torch.device) -> Iterator[Outcome]:
    """Check each stage in each precision that the device has, set as a user sets it.

    The first that fails is the one to examine. ``inherit`` may round as the process does.

    Args:
        run: as of ``ghgs train``; its model gets random weights.
        device: what is checked.

    Yields:
        An outcome for each stage and precision; one alone for a precision that the device lacks.
    """
    batch = _small_batch(run)
    expected = _results(Predictor(random_model(run.plain).double()), _in_float64(batch))
    for precision in PRECISIONS:
        reason = _unsupported(precision, device)
        if reason is not None:
            yield Outcome(f"model, {precision}", SKIPPED, reason)
            continue
        predictor = Predictor(random_model(run.plain).to(device), precision=precision)
        found = _results(predictor, batch.to(device))
        inherited = "tf32" if rounds_products(device.type) else "float32"
        limit = LIMITS[inherited if precision == "inherit" else precision]
        for stage, value in expected.items():
            # Geometry is always float32.
            allowed = LIMITS["float32"] if stage == "bounds" else limit
            yield compared(f"model, {precision}: {stage}", found[stage], value, allowed)


@torch.no_grad()
def capture(run: Run, device: torch.device) -> Iterator[Outcome]:
    """Check a prediction that is replayed as a CUDA graph against an eager one.

    Args:
        run: as of ``ghgs train``; its model gets random weights.
        device: what is checked.

    Yields:
        One outcome, with the reason where nothing is captured.
    """
    predictor = Predictor(random_model(run.plain).to(device), precision="float32")
    batch = _small_batch(run).to(device)
    expected, _, found = (predictor(batch).gaussians.means for _ in range(3))
    if predictor.graphs.counts["replayed"]:
        yield compared("captured prediction", found, expected, LIMITS["float32"])
        return
    off = "model.capture=off" if predictor.options.capture == "off" else f"no graphs on {device.type}"
    yield Outcome("captured prediction", SKIPPED, "; ".join(predictor.graphs.reasons) or off)


def gradient(run: Run, device: torch.device) -> Iterator[Outcome]:
    """Check the gradient of all weights in float32, as ``trainer.precision=32-true`` has it.

    Args:
        run: as of ``ghgs train``; its model gets random weights.
        device: what is checked.

    Yields:
        One outcome: the first of :data:`_MODELS` random models that passes, or the last one.
    """
    batch = _small_batch(run)
    outcomes = []
    for seed in range(_MODELS):
        expected = _gradients(random_model(run.plain, seed).double(), _in_float64(batch))
        with exact(device.type):
            found = _gradients(random_model(run.plain, seed).to(device), batch.to(device))
        outcomes.append(compared("gradient of the weights, float32", found, expected, GRADIENT_LIMIT))
        if outcomes[-1].status == PASSED:
            break
    yield outcomes[-1]


CHECKS = (renderer, stages, capture, gradient)


def _small_batch(run: Run) -> Batch:
    batch = ellipsoid_batch(0.15, 3, 4 * run.encoder.patch_size, 2)
    return replace(batch, targets=None)


def _in_float64(batch: Batch) -> Batch:
    return replace(batch, images=batch.images.double(), cameras=batch.cameras.to(torch.float64))


def _unsupported(precision: str, device: torch.device) -> str | None:
    if precision in ("float16", "tf32") and device.type != "cuda":
        return f"{precision} runs on CUDA only, not on {device.type}"
    if precision == "bfloat16" and not has_bfloat16(device):
        return f"{device.type} has no bfloat16 instructions here"
    return None


@torch.no_grad()
def _results(predictor: Predictor, batch: Batch) -> dict[str, Tensor]:
    """What the stages give for the subject, by the name of the stage, on the CPU."""
    seen = Results()
    with watched(predictor.model, {name: name for name in ("encoder", "recalibration")}, seen):
        prediction = predictor(batch).to("cpu")
    encoder, recalibration = (torch.stack(tokens.latent).cpu() for tokens in seen.results.values())
    bounds = prediction.depth_maps.bounds
    points = prediction.points
    masks = batch.masks.cpu()
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
    """Gradient of a number that depends on all attributes by all weights [n],
    in float64 on the CPU."""
    gaussians = Predictor(model.requires_grad_(True))(batch).gaussians
    sum(_waves(getattr(gaussians, name)).mean() for name in ATTRIBUTES).backward()
    rows = [torch.zeros_like(p) if p.grad is None else p.grad for p in model.parameters()]
    return torch.cat([row.cpu().double().flatten() for row in rows])


def _waves(values: Tensor) -> Tensor:
    """Values times weights of both signs; the sum of squares of a unit quaternion has
    no gradient."""
    weights = torch.arange(values.numel(), device=values.device, dtype=torch.float32).cos()
    return values * weights.view_as(values).to(values.dtype)
