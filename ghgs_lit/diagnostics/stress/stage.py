"""Families of adversarial inputs, and stages of the stress test: inputs, function,
reference and budget."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Generator, Tensor


@dataclass(frozen=True)
class Family:
    """A kind of inputs.

    Attributes:
        ingredient: what it changes; None: it applies to every stage.
        says: what the inputs are, in words.
    """

    ingredient: str | None
    says: str


FAMILIES = {
    "ordinary": Family(None, "values as in training"),
    "nan": Family(None, "one NaN in one input"),
    "inf": Family(None, "one infinity in one input"),
    "shifted": Family("cameras", "the world's origin is 1e4 m away"),
    "large": Family("cameras", "a scene in millimetres, or of 1000 times the size"),
    "small": Family("cameras", "a scene in kilometres"),
    "wide": Family("cameras", "focal lengths of a fisheye, 0.1 of the image"),
    "long": Family("cameras", "focal lengths of 1e5 px, the camera as far away"),
    "skewed": Family("cameras", "rotations that are orthogonal to 1e-3 only"),
    "mirrored": Family("cameras", "extrinsics with a determinant of -1"),
    "degenerate": Family("cameras", "rotations of rank 2"),
    "zero_depth": Family("depths", "depths of 0"),
    "negative_depth": Family("depths", "depths below 0"),
    "near_zero_depth": Family("depths", "depths of 1e-12"),
    "huge_depth": Family("depths", "depths of 1e12"),
    "equal_depths": Family("depths", "all depths equal"),
    "behind": Family("points", "points behind the camera"),
    "on_camera": Family("points", "points 1e-6 from the camera's centre"),
    "beside": Family("points", "points beside the frame, whose splats reach into it"),
    "far": Family("points", "points 1e6 m away"),
    "duplicates": Family("points", "all points twice"),
    "collapsed": Family("points", "all points at one place"),
    "few": Family("neighbors", "fewer points than k"),
    "single": Family("neighbors", "one point"),
    "zero_quaternion": Family("quaternions", "quaternions of 0"),
    "tiny_quaternion": Family("quaternions", "quaternions of length 1e-20"),
    "huge_quaternion": Family("quaternions", "quaternions of length 1e20"),
    "zero_scale": Family("scales", "scales of 0"),
    "tiny_scale": Family("scales", "scales of 1e-12"),
    "huge_scale": Family("scales", "scales of 1e4 m"),
    "thin": Family("scales", "scales with an aspect of 1e6"),
    "transparent": Family("opacities", "opacities of 0"),
    "opaque": Family("opacities", "opacities of 1"),
    "stacked": Family("opacities", "thousands of splats on one line of sight"),
    "zero_features": Family("features", "features of 0"),
    "tiny_features": Family("features", "features of length 1e-20"),
    "huge_features": Family("features", "features of length 1e18"),
    "parallel_features": Family("features", "all features equal"),
    "opposite_features": Family("features", "pairs of opposite features"),
    "saturated": Family("raw values", "raw values of +-100"),
    "extreme": Family("raw values", "raw values of +-1e4"),
    "constant": Family("images", "images of one colour"),
    "black": Family("images", "black images"),
    "identical": Family("images", "image and target are equal"),
    "out_of_range": Family("images", "colours from -10 to 10"),
    "empty_mask": Family("masks", "a view without the subject"),
    "one_pixel": Family("masks", "a mask of one pixel"),
    "noise_mask": Family("masks", "a mask of noise"),
    "wrong_mask": Family("masks", "one mask half cut off"),
    "kicked": Family("weights", "after a step of a learning rate of 10"),
}

#: Families with a value that is not finite, which must be refused or show in the outputs.
PLANTED = {"nan": float("nan"), "inf": float("inf")}


Values = dict[str, Tensor]

#: Names of dtypes; the last two run in autocast, with inputs in float32.
DTYPES = ("float64", "float32", "bfloat16", "float16")

#: Largest factor of a budget.
LARGEST = 100.0


@dataclass(frozen=True)
class Stage:
    """A row of the matrix.

    The budget of a case is ``factor * eps * kappa`` of each output and gradient (its largest
    entry). ``kappa`` is the condition number of the reference at the case's inputs: its change
    under random roundings of the inputs, in units of eps.

    Args:
        ingredients: what the inputs contain; families of other ingredients do not apply.
        make: makes the inputs of one case in float64, from a family and a generator.
        run: computes outputs [n, ...] of n stacked cases in the dtype of the inputs.
        factor: at most :data:`LARGEST`.
        reference: computes the same in float64 by other means; None: ``run`` in float64.
        gradients: inputs whose gradients are compared, too.
        steady: inputs that are not rounded for kappa.
        seeds: number of cases of each family and dtype in the full run;
            a quick run misses rare failures.
        kind: a formula computes in float32 or wider, a kernel in float32 only,
            a network in autocast's dtype.
        kappa: lower bound of the condition number,
            where the stage's definition subtracts large numbers.
        excluded: families that do not apply although their ingredient does, separated by spaces,
            with the reason.
        sizes: magnitude [n] of terms that cancel in the gradients by definition; where these are
            not unique and must only be finite, the largest number.
        refused: families that must be refused with an :class:`~ghgs_lit.errors.InputError`.
        silent: why a value that is not finite need not show in the outputs; empty: it must.
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
    kind: Literal["formula", "kernel", "network"] = "formula"
    kappa: Callable[[Values], Tensor] | None = None
    excluded: Mapping[str, str] = field(default_factory=dict)
    sizes: Callable[[Values], Tensor] | None = None
    refused: tuple[str, ...] = ()
    silent: str = ""

    def __post_init__(self) -> None:
        if not (0 < self.factor <= LARGEST and self.reason):
            raise ValueError(f"{self.name}: a budget needs a factor up to {LARGEST} and a reason")

    @property
    def dtypes(self) -> tuple[str, ...]:
        """Dtypes of its inputs."""
        return DTYPES[1:] if self.kind == "kernel" else DTYPES

    @property
    def quick(self) -> int:
        """Number of cases in a quick run: one of a stage that is slow, three of another."""
        return 1 if self.seeds < 25 else 3

    def has(self, family: str) -> bool:
        """Whether the stage has cases of a family."""
        ingredient = FAMILIES[family].ingredient
        fits = ingredient is None or ingredient in self.ingredients
        return fits and family not in " ".join(self.excluded).split()


def case_by_case(run: Callable[[Values], Values]) -> Callable[[Values], Values]:
    """Turn a function of one case into one of stacked cases.

    Args:
        run: takes the values of a case without the first axis.
    """

    def stacked(values: Values) -> Values:
        count = len(next(iter(values.values())))
        results = []
        for i in range(count):
            results.append(run({name: value[i] for name, value in values.items()}))
        return stack(results)

    return stacked


def stack(cases: list[Values]) -> Values:
    """Stack the values of cases, which have the same names and shapes, along a new first axis."""
    stacked = {}
    for name in cases[0]:
        stacked[name] = torch.stack([case[name] for case in cases])
    return stacked
