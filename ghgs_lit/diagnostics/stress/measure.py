"""Errors of a stage and family in all dtypes, in units of eps times the condition number."""

import math
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ghgs_lit.diagnostics.stress.stage import FAMILIES, PLANTED, Stage, Values, stack
from ghgs_lit.errors import InputError
from ghgs_lit.runs.results import plain

#: Relative size of the random roundings of inputs that estimate the condition number.
_STEP = torch.finfo(torch.float32).eps

#: A cell of the matrix: ``stage``, ``family``, ``dtype``; numbers of ``cases`` and ``failures``;
#: largest ``error`` and ``median`` in units of eps times the condition number (None: unbounded);
#: ``budget``, the allowed factor; ``nonfinite``, the share of cases with a value that is not
#: finite; ``gradient``, the median of the largest gradient; ``worst``, the output and seed of the
#: largest error; ``seconds``.
Row = dict[str, Any]


@dataclass(frozen=True)
class Outcome:
    """Errors of n cases."""

    errors: Tensor  #: in units of eps times the condition number [n]; infinite if unbounded
    lost: Tensor  #: whether a value is not finite [n]
    places: Sequence[str]  #: name of what has the error, for each case
    gradient: float = 0.0  #: median of the largest gradient


def measure(
    stage: Stage, family: str, seeds: Sequence[int], dtypes: Sequence[str] | None = None
) -> list[Row]:
    """Cells of a stage and family. What a stage raises is a failure of all its cases.

    Args:
        stage: a row of the matrix.
        family: a key of :data:`FAMILIES` that the stage has.
        seeds: one for each case.
        dtypes: among those of the stage; None: all of them.

    Returns:
        One row for each dtype.
    """
    started = time.perf_counter()
    chosen = [dtype for dtype in stage.dtypes if dtypes is None or dtype in dtypes]
    # A case depends on stage, family and seed only.
    keys = [zlib.crc32(f"{stage.name}/{family}/{seed}".encode()) for seed in seeds]
    cases = stack([stage.make(family, torch.Generator().manual_seed(key)) for key in keys])
    try:
        if family in PLANTED:
            check = partial(_planted, stage, PLANTED[family], cases, seeds)
        elif family in stage.refused:
            check = partial(_refused, stage, cases)
        else:
            check = _comparison(stage, family, cases)
        outcomes = {dtype: check(dtype) for dtype in chosen}
    except Exception as error:
        # whatever a stage raises is a failure of its own, and the others go on
        message = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
        none = torch.full((len(seeds),), torch.inf)
        outcomes = dict.fromkeys(chosen, Outcome(none, none > 0, [message] * len(seeds)))
    seconds = (time.perf_counter() - started) / max(len(chosen), 1)
    return [_row(stage, family, dtype, seeds, outcome, seconds) for dtype, outcome in outcomes.items()]


def _row(
    stage: Stage, family: str, dtype: str, seeds: Sequence[int], outcome: Outcome, seconds: float
) -> Row:
    """A cell of the matrix as plain data.

    Args:
        stage: of the cell.
        family: of the cell.
        dtype: of the cell.
        seeds: of its cases, for the worst one.
        outcome: errors of the cases.
        seconds: that the cell took.
    """
    errors = outcome.errors
    case = int(outcome.errors.argmax())
    return plain(
        {
            "stage": stage.name,
            "family": family,
            "dtype": dtype,
            "cases": len(seeds),
            "failures": int((errors > stage.factor).sum()),
            "error": float(errors[case]),
            "median": float(errors.median()),
            "budget": stage.factor,
            "nonfinite": float(outcome.lost.float().mean()),
            "gradient": outcome.gradient,
            "worst": f"{outcome.places[case]}, seed {seeds[case]}",
            "seconds": seconds,
        }
    )


def evaluate(run: Callable[[Values], Values], inputs: Values, gradients: Sequence[str], dtype: str) -> Values:
    """Run a function, and differentiate a weighted sum of all its outputs.

    Args:
        run: from inputs to outputs [n, ...] of n cases.
        inputs: [n, ...] by name; floating-point ones have the working precision.
        gradients: names of the inputs to differentiate by; none: no gradients are computed.
        dtype: one of :data:`ghgs_lit.diagnostics.stress.stage.DTYPES`; bfloat16 and float16 run in
            autocast.

    Returns:
        Outputs by name, and gradients as ``d <input>``, in float64.
    """
    leaves = {
        name: value.detach().requires_grad_(name in gradients) if value.is_floating_point() else value
        for name, value in inputs.items()
    }
    half = dtype in ("bfloat16", "float16")
    with torch.set_grad_enabled(bool(gradients)):
        with torch.autocast("cpu", getattr(torch, dtype) if half else torch.bfloat16, enabled=half):
            outputs = run(leaves)
        results = {name: value.detach().double() for name, value in outputs.items()}
        if gradients:
            total = sum((value.double() * _weights(name, value)).sum() for name, value in outputs.items())
            wanted = [leaves[name] for name in gradients]
            slopes = torch.autograd.grad(total, wanted, allow_unused=True)
            for name, slope in zip(gradients, slopes, strict=True):
                slope = torch.zeros_like(leaves[name]) if slope is None else slope
                results[f"d {name}"] = slope.detach().double()
    return results


def _weights(name: str, value: Tensor) -> Tensor:
    """Random weights of an output's entries, the same for all cases and dtypes."""
    g = torch.Generator().manual_seed(zlib.crc32(name.encode()))
    return torch.randn(value.shape[1:], generator=g, dtype=torch.float64)


def _comparison(stage: Stage, family: str, cases: Values) -> Callable[[str], Outcome]:
    """The check of a family whose outputs are compared with the reference,
    which runs once for all dtypes.

    Args:
        stage: of the cases.
        family: of the cases.
        cases: inputs [n, ...] by name in float64.

    Returns:
        From a dtype to the outcome.
    """
    # Inputs that all dtypes represent exactly: their rounding is not the stage's error.
    exact = _inputs(_inputs(cases, "float32"), "float64")
    run = partial(evaluate, stage.reference or stage.run, gradients=stage.gradients, dtype="float64")
    truth = run(exact)
    return partial(_compared, stage, family, exact, truth, _spread(run, exact, truth, stage))


def _inputs(cases: Values, dtype: str) -> Values:
    working = torch.float64 if dtype == "float64" else torch.float32
    return {k: v.to(working) if v.is_floating_point() else v for k, v in cases.items()}


def _spread(run: Callable[[Values], Values], exact: Values, truth: Values, stage: Stage) -> Values:
    """Largest change of each output of the reference under random roundings of the inputs,
    over their size.

    Two roundings have size eps. Two more are opposite and as large as the budget, so that one of
    them flips any decision within it (a ray that grazes a box).

    Args:
        run: the reference, with gradients among its outputs.
        exact: inputs [n, ...] by name in float64.
        truth: outputs of ``run`` for them.
        stage: says which inputs are steady, and the budget.

    Returns:
        Changes [n] by the names of ``truth``.
    """
    spread = {name: torch.zeros(len(value), dtype=torch.float64) for name, value in truth.items()}
    for seed, size in ((0, 1), (1, 1), (2, stage.factor), (2, -stage.factor)):
        g = torch.Generator().manual_seed(seed)
        step = size * _STEP
        moved = dict(exact)
        for name, value in exact.items():
            if value.is_floating_point() and name not in stage.steady:
                signs = 1 - 2 * torch.randint(2, value.shape, generator=g)
                moved[name] = value * (1 + step * signs)
        results = run(moved)
        for name, value in truth.items():
            spread[name] = torch.maximum(spread[name], _largest(results[name] - value) / abs(step))
    return spread


def _largest(values: Tensor) -> Tensor:
    """Largest magnitude of each case; infinite where a value is not finite."""
    flat = values.reshape(len(values), -1).abs()
    flat = torch.where(flat.isfinite(), flat, torch.inf)
    return flat.amax(1) if flat.shape[1] else flat.new_zeros(len(flat))


def _compared(stage: Stage, family: str, exact: Values, truth: Values, spread: Values, dtype: str) -> Outcome:
    """Errors of outputs and gradients in units of eps times the condition number.

    Args:
        stage: is run.
        family: of the cases.
        exact: inputs [n, ...] by name in float64, which all dtypes represent exactly.
        truth: outputs and gradients of the reference.
        spread: from :func:`_spread`.
        dtype: in which the stage runs.
    """
    working = torch.float64 if dtype == "float64" else torch.float32
    results = truth  # where a stage is its own reference
    if dtype != "float64" or stage.reference is not None:
        results = evaluate(stage.run, _inputs(exact, dtype), stage.gradients, dtype)
    eps = torch.finfo(getattr(torch, dtype) if stage.kind == "network" else working).eps
    floor = torch.finfo(working).tiny / eps
    ratios = {}
    for name, value in truth.items():
        scale = _largest(value)
        slope = name.startswith("d ")
        if stage.kappa is not None and not slope:
            scale = scale * stage.kappa(exact).clamp(min=1)
        if stage.sizes is not None and slope:
            scale = torch.maximum(scale, stage.sizes(exact))
        ratios[name] = _largest(results[name] - value) / (eps * (scale + spread[name] + floor))
    names = list(ratios)
    table = torch.stack(list(ratios.values())).nan_to_num(nan=math.inf, posinf=math.inf)
    largest = torch.stack([_largest(results[name]) for name in names])
    lost = ~largest.isfinite().all(0)
    if dtype == "float16" and FAMILIES[family].ingredient == "weights":
        # Products may exceed 65 504, float16's largest number; the result must then not be finite.
        table = torch.where(lost, 0.0, table)
    errors, row = table.max(0)
    slopes = largest[[name.startswith("d ") for name in names]]
    gradient = float(slopes.amax(0).median()) if len(slopes) else 0.0
    return Outcome(errors, lost, [names[i] for i in row.tolist()], gradient)


def _refused(stage: Stage, cases: Values, dtype: str) -> Outcome:
    """Error of cases that must be refused: 0 where an InputError is raised, else infinite.

    Args:
        stage: is run for each case by itself.
        cases: inputs [n, ...] by name in float64.
        dtype: in which the stage runs.
    """
    inputs = _inputs(cases, dtype)
    errors = []
    for i in range(len(next(iter(cases.values())))):
        try:
            evaluate(stage.run, {name: value[i : i + 1] for name, value in inputs.items()}, (), dtype)
            errors.append(math.inf)
        except InputError:
            errors.append(0.0)
    lost = torch.zeros(len(errors))
    return Outcome(torch.tensor(errors), lost, ["refused in one line"] * len(errors))


def _planted(stage: Stage, value: float, cases: Values, seeds: Sequence[int], dtype: str) -> Outcome:
    """Plant a value that is not finite in one entry of one input of each case.

    Args:
        stage: is run for each case beside the next one.
        value: NaN or an infinity.
        cases: inputs [n, ...] by name in float64.
        seeds: of the cases [n], which choose the entries.
        dtype: in which the stage runs.

    Returns:
        Errors of 0 where the value is refused, or shows in the outputs (unless the stage is silent)
        and reaches no other case; else infinite.
    """
    inputs = _inputs(cases, dtype)
    names = [name for name, x in inputs.items() if x.is_floating_point() and name not in stage.steady]
    errors = torch.zeros(len(seeds))
    lost = torch.zeros(len(seeds))
    places = []
    for i, seed in enumerate(seeds):
        pair = {name: x[[i, (i + 1) % len(seeds)]].clone() for name, x in inputs.items()}
        name = names[i % len(names)]
        g = torch.Generator().manual_seed(seed)
        entries = pair[name][0].view(-1)
        entries[int(torch.randint(len(entries), (), generator=g))] = value
        places.append(f"in {name}")
        try:
            results = evaluate(stage.run, pair, stage.gradients, dtype)
        except InputError:
            continue
        first, other = torch.stack([x.reshape(2, -1).isfinite().all(1) for x in results.values()]).all(0)
        lost[i] = not first
        if not other or (first and not stage.silent):
            errors[i] = math.inf
            places[i] = f"{'vanished' if other else 'reached another case'} from {name}"
    return Outcome(errors, lost, places)
