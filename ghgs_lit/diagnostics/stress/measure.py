"""Errors of one stage and family in all dtypes, in units of the problem's own sensitivity."""

import math
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from ghgs_lit.diagnostics.stress.families import FAMILIES, PLANTED
from ghgs_lit.diagnostics.stress.stage import Stage, Values
from ghgs_lit.errors import InputError

#: Size of the random roundings of the inputs that estimate the condition number, in relative terms.
_STEP = torch.finfo(torch.float32).eps


@dataclass(frozen=True)
class Cell:
    """What was found for a stage, a family and a dtype.

    ``error`` and ``median`` are in units of eps times the condition number, ``budget`` is the allowed factor;
    ``nonfinite`` is the share of cases with a value that is not finite where the reference is; ``gradient``
    is the median of the largest gradient; ``worst`` says which output and seed.
    """

    stage: str
    family: str
    dtype: str
    cases: int
    failures: int
    error: float
    median: float
    budget: float
    nonfinite: float
    gradient: float
    worst: str
    seconds: float

    def as_dict(self) -> dict:
        """Plain data; an error without a bound is None, since JSON has no infinity."""
        values = asdict(self)
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}


def make_cases(stage: Stage, family: str, seeds: Sequence[int]) -> Values:
    """Stacked inputs [n, ...] in float64; a case depends on stage, family and seed only."""
    cases = []
    for seed in seeds:
        key = zlib.crc32(f"{stage.name}/{family}/{seed}".encode())
        cases.append(stage.make(family, torch.Generator().manual_seed(key)))
    return {name: torch.stack([case[name] for case in cases]) for name in cases[0]}


def evaluate(run: Callable[[Values], Values], inputs: Values, gradients: Sequence[str], dtype: str) -> Values:
    """Outputs, and gradients of their weighted sum, in float64; ``dtype`` names an autocast, or none."""
    leaves = {
        name: value.detach().requires_grad_(name in gradients) if value.is_floating_point() else value
        for name, value in inputs.items()
    }
    half = dtype in ("bfloat16", "float16")
    with torch.set_grad_enabled(bool(gradients)):
        with torch.autocast("cpu", getattr(torch, dtype) if half else torch.bfloat16, enabled=half):
            outputs = run(leaves)
        found = {name: value.detach().double() for name, value in outputs.items()}
        if gradients:
            total = sum((value.double() * _weights(name, value)).sum() for name, value in outputs.items())
            wanted = [leaves[name] for name in gradients]
            slopes = torch.autograd.grad(total, wanted, allow_unused=True)
            for name, slope in zip(gradients, slopes, strict=True):
                slope = torch.zeros_like(leaves[name]) if slope is None else slope
                found[f"d {name}"] = slope.detach().double()
    return found


def _weights(name: str, value: Tensor) -> Tensor:
    """Weights of an output's entries, the same for all cases and dtypes: a sum hides no sign."""
    g = torch.Generator().manual_seed(zlib.crc32(name.encode()))
    return torch.randn(value.shape[1:], generator=g, dtype=torch.float64)


def measure(
    stage: Stage, family: str, seeds: Sequence[int], dtypes: Sequence[str] | None = None
) -> list[Cell]:
    """The cells of a family: one for each dtype of the stage (or for those of ``dtypes`` among them)."""
    chosen = [dtype for dtype in stage.dtypes if dtypes is None or dtype in dtypes]
    cases = make_cases(stage, family, seeds)
    if family in PLANTED:
        return [_planted(stage, family, cases, seeds, dtype) for dtype in chosen]
    if family in stage.refused:
        return [_refused(stage, family, cases, seeds, dtype) for dtype in chosen]
    # What all dtypes can represent: the rounding of the inputs is not the stage's error.
    exact = {k: v.float().double() if v.is_floating_point() else v for k, v in cases.items()}
    reference = stage.reference or stage.run
    started = time.perf_counter()
    truth = evaluate(reference, exact, stage.gradients, "float64")
    spread = _spread(reference, exact, truth, stage)
    shared = (time.perf_counter() - started) / max(len(chosen), 1)
    return [_compare(stage, family, exact, truth, spread, seeds, dtype, shared) for dtype in chosen]


def _spread(reference, exact: Values, truth: Values, stage: Stage) -> Values:
    """How far each output of the reference moves where the inputs are rounded at random, over the rounding.

    Two roundings are of one step. The other two are opposite and as large as the budget: a decision that
    falls within it (a ray that grazes a box) jumps for one of them.
    """
    spread = {name: torch.zeros(len(value), dtype=torch.float64) for name, value in truth.items()}
    for seed, size in ((0, 1), (1, 1), (2, stage.factor), (2, -stage.factor)):
        g, step = torch.Generator().manual_seed(seed), size * _STEP
        moved = {}
        for name, value in exact.items():
            moved[name] = value
            if value.is_floating_point() and name not in stage.steady:
                signs = 1 - 2 * torch.randint(2, value.shape, generator=g)
                moved[name] = value * (1 + step * signs)
        found = evaluate(reference, moved, stage.gradients, "float64")
        for name, value in truth.items():
            spread[name] = torch.maximum(spread[name], _largest(found[name] - value) / abs(step))
    return spread


def _largest(values: Tensor) -> Tensor:
    """Largest magnitude of each case; infinite where a value is not finite."""
    flat = values.reshape(len(values), -1).abs()
    flat = torch.where(flat.isfinite(), flat, torch.inf)
    return flat.amax(1) if flat.shape[1] else flat.new_zeros(len(flat))


def _compare(stage, family, exact, truth, spread, seeds, dtype, shared) -> Cell:
    started = time.perf_counter()
    working = torch.float64 if dtype == "float64" else torch.float32
    found = evaluate(stage.run, _inputs(exact, dtype), stage.gradients, dtype)
    eps = torch.finfo(getattr(torch, dtype) if stage.network else working).eps
    floor = torch.finfo(working).tiny / eps
    ratios = {}
    for name, value in truth.items():
        scale = _largest(value)
        slope = name.startswith("d ")
        if stage.kappa is not None and not slope:
            scale = scale * stage.kappa(exact).clamp(min=1)
        if stage.sizes is not None and slope:
            scale = torch.maximum(scale, stage.sizes(exact))
        if slope and family in stage.ties:
            scale = torch.full_like(scale, torch.finfo(torch.float64).max)
        ratios[name] = _largest(found[name] - value) / (eps * (scale + spread[name] + floor))
    names = list(ratios)
    table = torch.stack([ratios[name].nan_to_num(nan=math.inf, posinf=math.inf) for name in names])
    lost = (~torch.stack([_largest(found[name]) for name in names]).isfinite()).any(0)
    if dtype == "float16" and FAMILIES[family].ingredient == "weights":
        # Weights may take products beyond 65 504, float16's largest number: then the result must say so.
        table = torch.where(lost, 0.0, table)
    worst, place = table.max(0)
    case = int(worst.argmax())
    gradient = [_largest(found[name]) for name in names if name.startswith("d ")]
    return Cell(
        stage.name,
        family,
        dtype,
        cases=len(seeds),
        failures=int((worst > stage.factor).sum()),
        error=float(worst[case]),
        median=float(worst.median()),
        budget=stage.factor,
        nonfinite=float(lost.float().mean()),
        gradient=float(torch.stack(gradient).amax(0).median()) if gradient else 0.0,
        worst=f"{names[int(place[case])]}, seed {seeds[case]}",
        seconds=shared + time.perf_counter() - started,
    )


def _inputs(cases: Values, dtype: str) -> Values:
    working = torch.float64 if dtype == "float64" else torch.float32
    return {k: v.to(working) if v.is_floating_point() else v for k, v in cases.items()}


def _verdict(
    stage: Stage, family: str, dtype: str, seeds, failed: int, seen: float, said: str, started
) -> Cell:
    """The cell of cases that hold or fail, without an error in between."""
    return Cell(
        stage.name,
        family,
        dtype,
        cases=len(seeds),
        failures=failed,
        error=math.inf if failed else 0.0,
        median=0.0,
        budget=stage.factor,
        nonfinite=seen,
        gradient=0.0,
        worst=said,
        seconds=time.perf_counter() - started,
    )


def _refused(stage: Stage, family: str, cases: Values, seeds: Sequence[int], dtype: str) -> Cell:
    """Each case alone must raise an ``InputError``."""
    started, failed = time.perf_counter(), 0
    inputs = _inputs(cases, dtype)
    for i in range(len(seeds)):
        try:
            evaluate(stage.run, {name: value[i : i + 1] for name, value in inputs.items()}, (), dtype)
            failed += 1
        except InputError:
            continue
    return _verdict(stage, family, dtype, seeds, failed, 0.0, "refused in one line", started)


def _planted(stage: Stage, family: str, cases: Values, seeds: Sequence[int], dtype: str) -> Cell:
    """A value that is not finite is refused, or seen in the outputs, and reaches no other case.

    The error is 0 where that holds, else infinite.
    """
    started = time.perf_counter()
    inputs = _inputs(cases, dtype)
    names = [name for name, value in inputs.items() if value.is_floating_point() and name not in stage.steady]
    failed, seen, said = 0, 0, ""
    for i, seed in enumerate(seeds):
        pair = {name: value[[i, (i + 1) % len(seeds)]].clone() for name, value in inputs.items()}
        chosen = pair[names[i % len(names)]]
        g = torch.Generator().manual_seed(seed)
        chosen[0].view(-1)[int(torch.randint(chosen[0].numel(), (), generator=g))] = PLANTED[family]
        try:
            found = evaluate(stage.run, pair, stage.gradients, dtype)
        except InputError:
            continue
        rows = torch.stack([value.reshape(len(value), -1).isfinite().all(1) for value in found.values()]).all(
            0
        )
        seen += not rows[0]
        if not rows[1] or (rows[0] and not stage.silent):
            failed += 1
            what = "reached another case" if not rows[1] else "vanished"
            said = f"{what} from {names[i % len(names)]}, seed {seed}"
    return _verdict(stage, family, dtype, seeds, failed, seen / len(seeds), said, started)
