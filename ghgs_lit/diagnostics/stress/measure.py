"""Stages of the stress test, and their errors in units of eps times the condition number."""

import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Generator, Tensor
from torch.nn.functional import pad
from torch.utils.data import default_collate

from ghgs_lit.diagnostics.stress.families import F64, FAMILIES, Values
from ghgs_lit.errors import InputError
from ghgs_lit.runs.results import to_json_data

#: Precisions of the runs; the last two are autocast, with inputs in float32.
DTYPES = ("float32", "bfloat16", "float16")
#: Families with a value that is not finite: the stage must reject it, or outputs must not be finite.
PLANTED = {"nan": math.nan, "inf": math.inf}
#: Largest relative difference of gradients in float64 from central differences.
SLOPES = 1e-3
#: Relative size of the random roundings of inputs that estimate the condition number.
_STEP = torch.finfo(torch.float32).eps

#: A cell of the matrix: ``stage``, ``family``, ``dtype``; numbers of ``cases`` and ``failures``;
#: largest ``error`` in units of eps times the condition number (None: infinite); ``budget``, the largest
#: allowed error; ``worst``, the output and seed of the largest error.
Row = dict[str, Any]
Errors = tuple[Tensor, list[str]]  #: Errors [n] of n cases in these units, and the output that has each


@dataclass(frozen=True)
class Stage:
    """A function that is compared with itself in float64.

    The largest error of each output and gradient of a case may be ``factor * eps * kappa``. ``kappa`` is
    the condition number of the case: the change of the float64 results under random roundings of the
    inputs, in units of eps.

    Args:
        ingredients: of the inputs; families of other ingredients do not apply.
        make: makes the inputs of one case in float64, from a family and a generator.
        run: computes outputs [n, ...] of n stacked cases in the dtype of the inputs; or in float32 by a
            kernel and in float64 by its plain form.
        factor: of the budget, at most 100.
        reason: of the factor.
        gradients: inputs whose gradients are also compared.
        steady: inputs that are neither rounded for kappa nor replaced by values that are not finite.
        seeds: number of cases of each family and dtype in the full run.
        is_network: whether the stage computes in the dtype of autocast; others compute in float32 or
            wider.
        kappa: lower bound of the condition number [n] (or [1], of all cases),
            where the stage's definition subtracts large numbers.
        sizes: magnitude [n] of terms of the gradients that cancel by definition; the largest float64 where
            gradients are not unique, and need only be finite.
        without: families that do not apply although their ingredient does.
        silent: why outputs may be finite although an input is not; empty: they must not.
    """

    name: str
    ingredients: tuple[str, ...]
    make: Callable[[str, Generator], Values]
    run: Callable[[Values], Values]
    factor: float
    reason: str
    gradients: tuple[str, ...] = ()
    steady: tuple[str, ...] = ()
    seeds: int = 128
    is_network: bool = False
    kappa: Callable[[Values], Tensor] = lambda cases: torch.ones(1)
    sizes: Callable[[Values], Tensor] = lambda cases: torch.zeros(1)
    without: tuple[str, ...] = ()
    silent: str = ""

    @property
    def families(self) -> list[str]:
        """Families that apply."""
        known = (None, *self.ingredients)
        return [n for n, family in FAMILIES.items() if family.ingredient in known and n not in self.without]

    def rounded(self, cases: Values) -> list[str]:
        """Names of the inputs that are rounded for kappa or replaced by values that are not finite."""
        return [n for n, value in cases.items() if value.is_floating_point() and n not in self.steady]


def case_by_case(run: Callable[[Values], Values]) -> Callable[[Values], Values]:
    """Turn a function of one case into one of stacked cases."""

    def run_stacked(values: Values) -> Values:
        cases = zip(*values.values(), strict=True)
        return default_collate([run(dict(zip(values, case, strict=True))) for case in cases])

    return run_stacked


def measure(stage: Stage, family: str, seeds: int, dtypes: Sequence[str] = DTYPES) -> list[Row]:
    """Cells of a stage and family, one for each dtype. An exception is a failure of all its cases."""
    # A case depends on stage, family and seed only.
    keys = [zlib.crc32(f"{stage.name}/{family}/{seed}".encode()) for seed in range(seeds)]
    cases = default_collate([stage.make(family, Generator().manual_seed(key)) for key in keys])
    # Inputs that all dtypes represent exactly: their rounding is not the stage's error.
    cases = {name: value.float() if value.is_floating_point() else value for name, value in cases.items()}
    try:
        if family in PLANTED:
            results = [_plant(stage, PLANTED[family], cases, dtype) for dtype in dtypes]
        else:
            results = _compare(stage, family, cases, dtypes)
    except Exception as error:  # a failure of this stage; the others are measured
        is_rejected = family == "out_of_range" and isinstance(error, InputError)
        message = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
        results = [(torch.full((seeds,), 0.0 if is_rejected else math.inf), [message] * seeds)] * len(dtypes)
    rows = []
    for dtype, (errors, places) in zip(dtypes, results, strict=True):
        worst = int(errors.argmax())
        row = {"stage": stage.name, "family": family, "dtype": dtype, "cases": seeds}
        row |= {"failures": int((errors > stage.factor).sum()), "error": float(errors[worst])}
        rows.append(to_json_data(row | {"budget": stage.factor, "worst": f"{places[worst]}, seed {worst}"}))
    return rows


def evaluate(stage: Stage, inputs: Values, dtype: str) -> tuple[Values, Tensor]:
    """Run a stage, and differentiate a weighted sum of all its outputs.

    Args:
        stage: to run.
        inputs: [n, ...] by name, in float32 or float64.
        dtype: of autocast, if it is a half precision.

    Returns:
        Outputs by name, and gradients as ``d <input>``, in float64; and the sums [n].
    """
    leaves = {name: x.detach().requires_grad_(name in stage.gradients) for name, x in inputs.items()}
    with torch.set_grad_enabled(bool(stage.gradients)):
        with torch.autocast("cpu", getattr(torch, dtype), enabled=dtype in DTYPES[1:]):
            outputs = stage.run(leaves)
        total = sum(_weighted_sum(name, value.double()) for name, value in outputs.items())
    results = {name: value.detach().double() for name, value in outputs.items()}
    if stage.gradients:
        wanted = [leaves[name] for name in stage.gradients]
        slopes = torch.autograd.grad(total.sum(), wanted, materialize_grads=True)
        results |= {f"d {name}": slope.double() for name, slope in zip(stage.gradients, slopes, strict=True)}
    return results, total.detach()


def _weighted_sum(name: str, value: Tensor) -> Tensor:
    """Sum [n] of an output's entries with random weights, the same for all cases and dtypes."""
    g = Generator().manual_seed(zlib.crc32(name.encode()))
    weights = torch.randn(value.shape[1:], generator=g, dtype=F64)
    return (weights * value).reshape(len(value), -1).sum(1)


def _largest(values: Tensor) -> Tensor:
    """Largest magnitude of each case; infinite where a value is not finite, 0 without values."""
    flat = values.reshape(len(values), -1).abs()
    return pad(flat.nan_to_num(nan=math.inf, posinf=math.inf), (0, 1)).amax(1)


def _compare(stage: Stage, family: str, cases: Values, dtypes: Sequence[str]) -> list[Errors]:
    """Errors for each dtype."""
    exact = {name: value.double() if value.is_floating_point() else value for name, value in cases.items()}
    truth, _ = evaluate(stage, exact, "float64")
    kappa = condition(stage, exact, truth)
    names = list(truth)
    slopes = []
    if stage.gradients and family == "ordinary":
        names.append("gradients against differences")
        slopes.append(_slope_errors(stage, exact, truth) / SLOPES * stage.factor)
    results = []
    for dtype in dtypes:
        values, _ = evaluate(stage, cases, dtype)
        eps = torch.finfo(getattr(torch, dtype) if stage.is_network else torch.float32).eps
        floor = torch.finfo(torch.float32).tiny / eps
        ratios = [_largest(values[name] - truth[name]) / (eps * (kappa[name] + floor)) for name in truth]
        errors, place = torch.stack(ratios + slopes).nan_to_num(nan=math.inf, posinf=math.inf).max(0)
        if dtype == "float16" and FAMILIES[family].ingredient == "weights":
            # Products may exceed 65 504, float16's largest number; the result must then not be finite.
            is_lost = torch.stack([_largest(value) for value in values.values()]).isinf().any(0)
            errors = torch.where(is_lost, 0.0, errors)
        results.append((errors, [names[i] for i in place.tolist()]))
    return results


def _slope_errors(stage: Stage, exact: Values, truth: Values) -> Tensor:
    """Relative differences [n] of the float64 gradients from central differences in a random direction.

    They are large where a gradient is wrong in every precision, or where outputs are rounded to fewer digits.
    """
    g = Generator().manual_seed(3)
    ahead, behind, expected = {}, {}, []
    for name in stage.gradients:
        step = 1e-7 * exact[name] * torch.randn(exact[name].shape, generator=g, dtype=F64)
        ahead[name] = exact[name] + step
        behind[name] = exact[name] - step
        expected.append((truth[f"d {name}"] * step).flatten(1))
    sums = [evaluate(stage, exact | moved, "float64")[1] for moved in (ahead, behind)]
    products = torch.cat(expected, 1)
    return ((sums[0] - sums[1]) / 2 - products.sum(1)).abs() / products.abs().sum(1)


def condition(stage: Stage, exact: Values, truth: Values) -> Values:
    """Sizes of outputs and gradients, plus their largest change under random roundings of the inputs.

    Two roundings have size eps. Two more are opposite and as large as the budget, so that one of
    them flips any decision within it (a ray that grazes a box).

    Args:
        stage: has the budget, and the names of the inputs to round.
        exact: inputs [n, ...] by name in float64.
        truth: outputs and gradients in float64.

    Returns:
        Sizes [n] by the names of ``truth``.
    """
    spread = dict.fromkeys(truth, torch.zeros(1))
    for seed, size in ((0, _STEP), (1, _STEP), (2, stage.factor * _STEP), (2, -stage.factor * _STEP)):
        g = Generator().manual_seed(seed)
        moved = dict(exact)
        for name in stage.rounded(exact):
            signs = 1 - 2 * torch.randint(2, exact[name].shape[1:], generator=g)
            moved[name] = exact[name] * (1 + size * signs)
        for name, value in evaluate(stage, moved, "float64")[0].items():
            spread[name] = torch.maximum(spread[name], _largest(value - truth[name]) / abs(size))
    for name, value in truth.items():
        if name.startswith("d "):
            spread[name] += torch.maximum(_largest(value), stage.sizes(exact))
        else:
            spread[name] += _largest(value) * stage.kappa(exact).clamp(min=1)
    return spread


def _plant(stage: Stage, value: float, cases: Values, dtype: str) -> Errors:
    """Errors where one entry of one input of each case is not finite. Each is stacked with another case.

    The error is 0 where the stage rejects the value, or where outputs of the other case are finite and those
    of this case are not (or the stage is silent); else it is infinite.
    """
    names = stage.rounded(cases)
    count = len(cases[names[0]])
    errors = torch.zeros(count)
    places = [f"in {names[i % len(names)]}" for i in range(count)]
    for i in range(count):
        pair = {name: x[[i, (i + 1) % count]].clone() for name, x in cases.items()}
        entries = pair[names[i % len(names)]][0].view(-1)
        entries[int(torch.randint(len(entries), (), generator=Generator().manual_seed(i)))] = value
        try:
            results, _ = evaluate(stage, pair, dtype)
        except InputError:
            continue
        first, other = torch.stack([x.reshape(2, -1).isfinite().all(1) for x in results.values()]).all(0)
        if not other or (first and not stage.silent):
            errors[i] = math.inf
            places[i] += ": has no effect" if other else ": reaches another case"
    return errors, places
