"""One stage of the stress test: its inputs, the function, its reference, and its budget."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Generator, Tensor

from ghgs_lit.diagnostics.stress.families import FAMILIES

Values = dict[str, Tensor]

#: Names of the dtypes: the last two are those of autocast, with inputs in float32.
DTYPES = ("float64", "float32", "bfloat16", "float16")
#: Those of kernels and of photographs, which are never in float64.
FLOAT32_ONLY = DTYPES[1:]

#: The largest factor of a budget: more than this many roundings of its inputs no stage may lose.
LARGEST = 100.0


@dataclass(frozen=True)
class Stage:
    """A row of the matrix.

    The budget of a case is ``factor * eps * kappa`` of each output and gradient (its largest entry).
    ``kappa`` is the condition number of the reference at the case's inputs: how far it moves when each input
    is rounded at random, in units of eps.

    Args:
        ingredients: what the inputs contain; families of others do not apply.
        make: the inputs of one case in float64, from a family and a generator.
        run: outputs [n, ...] of n cases, whose inputs are stacked; in the dtype of the inputs.
        factor: at most :data:`LARGEST`.
        reference: the same in float64 by other means; None: ``run`` itself in float64.
        gradients: inputs whose gradients are compared, too.
        steady: inputs that are not rounded for kappa.
        seeds: cases of each family and dtype in the full run.
        quick: the same in a quick run, which says nothing of rare failures.
        network: computes in autocast's dtype; all others stay in float32 or wider.
        kappa: a least condition number, where the stage's definition subtracts large numbers.
        excluded: families that do not apply although their ingredient does, with the reason.
        sizes: size of the numbers [n] whose differences gradients are, where those cancel by definition.
        ties: families in which gradients are not unique; they must be finite only.
        refused: families that must be refused with an :class:`~ghgs_lit.errors.InputError`.
        silent: why a value that is not finite need not be seen in the outputs; empty: it must be.
    """

    name: str
    ingredients: tuple[str, ...]
    make: Callable[[str, Generator], Values]
    run: Callable[[Values], Values]
    factor: float
    reason: str
    reference: Callable[[Values], Values] | None = None
    gradients: tuple[str, ...] = ()
    steady: tuple[str, ...] = ()
    seeds: int = 128
    quick: int = 3
    network: bool = False
    dtypes: tuple[str, ...] = DTYPES
    kappa: Callable[[Values], Tensor] | None = None
    excluded: Mapping[str, str] = field(default_factory=dict)
    sizes: Callable[[Values], Tensor] | None = None
    ties: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
    silent: str = ""

    def __post_init__(self) -> None:
        if not (0 < self.factor <= LARGEST and self.reason):
            raise ValueError(f"{self.name}: a budget needs a factor up to {LARGEST} and a reason")

    def missing(self, family: str) -> str | None:
        """Why there are no cases of a family; None where there are."""
        ingredient = FAMILIES[family].ingredient
        if ingredient is not None and ingredient not in self.ingredients:
            return f"takes no {ingredient}"
        return self.excluded.get(family)


def except_for(reasons: Mapping[str, str]) -> dict[str, str]:
    """The families of ``excluded``: reasons by names that are separated by spaces."""
    return {name: reason for names, reason in reasons.items() for name in names.split()}


def case_by_case(run: Callable[[Values], Values]) -> Callable[[Values], Values]:
    """A function of one case as one of stacked cases."""

    def stacked(values: Values) -> Values:
        count = len(next(iter(values.values())))
        return stack([run({name: value[i] for name, value in values.items()}) for i in range(count)])

    return stacked


def stack(cases: list[Values]) -> Values:
    """Values of cases, stacked along a first axis."""
    return {name: torch.stack([case[name] for case in cases]) for name in cases[0]}
