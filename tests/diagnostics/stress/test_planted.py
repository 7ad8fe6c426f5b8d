"""Defects planted one at a time in the code of the stages: the stress test reports each of them."""

import ast
import inspect
import sys
import textwrap
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from benchmarks.planted_defects import change_code
from ghgs_lit.bounds.agreement import trusted_views
from ghgs_lit.diagnostics.stress.measure import measure
from ghgs_lit.diagnostics.stress.stages import STAGES, heads
from ghgs_lit.geometry import projection, rotations, undistortion
from ghgs_lit.geometry.padding import Padding
from ghgs_lit.metrics import functional
from ghgs_lit.recalibration import SemanticAttention, nearest_neighbors
from ghgs_lit.refinement import refinement
from ghgs_lit.rendering import reference
from ghgs_lit.rendering.cpu import backend
from ghgs_lit.rounds import gains


@dataclass(frozen=True)
class Defect:
    """A change of the code of ``function``, and a stage, a family and a dtype that show it."""

    says: str
    function: Callable
    change: str
    stage: str
    family: str
    dtype: str = "float32"

    def plant(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Change the function wherever it is known, until the test ends."""
        function = inspect.unwrap(self.function)
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
        change_code(tree, self.change)
        changed: dict[str, Callable] = {}
        exec(ast.unparse(tree), vars(sys.modules[function.__module__]), changed)
        code = inspect.unwrap(changed[function.__name__]).__code__
        monkeypatch.setattr(function, "__code__", code)


DEFECTS = (
    Defect(
        "a bare square root", rotations.unit, "squared = A.masked_fill(B, 1.0) → squared = A",
        "unit vectors", "zero_quaternion",
    ),
    Defect(
        "squares that overflow", rotations.unit, "scaled = x / A → scaled = x",
        "unit vectors", "huge_quaternion",
    ),
    Defect(
        "an epsilon that hides what is short", rotations.unit,
        "scaled * A → x / (x.norm(dim=-1, keepdim=True) + 1e-8)", "cosine", "tiny_features",
    ),
    Defect(
        "geometry in half precision", projection.unproject, "x * depth → x * depth.half().to(depth)",
        "unprojection", "ordinary",
    ),
    Defect(
        "a product that autocast catches", projection._camera_axes,
        "return A → return (extrinsics[..., :3, :3] @ points[..., None])[..., 0].movedim(-1, 0)",
        "projection", "ordinary", "bfloat16",
    ),
    Defect(
        "a softmax without its maximum", SemanticAttention._attend,
        "A.softmax(-1) → A.exp() / A.exp().sum(-1, keepdim=True)", "attention", "huge_features",
    ),
    Defect(
        "distances in half precision", nearest_neighbors,
        "points[..., rows, :] → points[..., rows, :].half().float()", "neighbours", "shifted",
    ),
    Defect(
        "distances by products", nearest_neighbors,
        "'donot_use_mm_for_euclid_dist' → 'use_mm_for_euclid_dist'", "neighbours", "shifted",
    ),
    Defect(
        "the map of another subject", projection.sample,
        "2 * image.to(pixels) + 1 → 2 * (image.to(pixels) + 1) % (2 * count) + 1",
        "samples of maps", "ordinary",
    ),
    Defect(
        "a quaternion over its squared length", rotations.quaternion_to_matrix,
        "q.norm(dim=-1, keepdim=True) → q.square().sum(-1, keepdim=True)",
        "quaternion and covariance", "ordinary",
    ),
    Defect(
        "a window whose sum is not 1", functional._gaussian_window, "A / A.sum() → A",
        "L1 and SSIM", "ordinary",
    ),
    Defect(
        "a border on the wrong side", Padding.pad_batch,
        "A.cropped(self.top, self.left, B, C) → A.cropped(self.top, -self.left, B, C)",
        "padding", "ordinary",
    ),
    Defect(
        "a wrong mask that keeps its vote", trusted_views, "voting & ~A → voting | ~A",
        "bounds and hull", "wrong_mask",
    ),
    Defect(
        "a Jacobian without its clamp", reference.project,
        "torch.minimum(torch.maximum(A, B), C) → A", "compositing", "beside",
    ),
    Defect(
        "a lens half a pixel beside its place", undistortion.undistorting_grid,
        
        "torch.linspace(0.5, A - 0.5, B, dtype=C) → torch.linspace(0, A - 1, B, dtype=C)",
        "undistortion", "ordinary",
    ),
    Defect(
        "the logarithm of black", gains._compared, "color.clamp(min=A).log() → color.log()",
        "gains", "black",
    ),
    Defect(
        "gains of the rounds that nothing holds", gains._solved, "prior * identity → 1e-9 * identity",
        "pipeline shipped", "ordinary",
    ),
    Defect(
        "colours that move beyond their limit", refinement.Descent._changed, "c.limit * A → A",
        "refinement", "ordinary",
    ),
)  # fmt: skip


def failures(stage: str, family: str, dtype: str) -> int:
    """How many of three cases fail."""
    return sum(row["failures"] for row in measure(STAGES[stage], family, range(3), [dtype]))


@pytest.mark.parametrize("defect", DEFECTS, ids=lambda defect: defect.says)
def test_a_changed_line_is_reported(defect, monkeypatch):
    """Without the defect the same cases pass."""
    assert failures(defect.stage, defect.family, defect.dtype) == 0
    defect.plant(monkeypatch)
    assert failures(defect.stage, defect.family, defect.dtype) > 0


def test_a_confidence_without_its_limit_is_reported(monkeypatch):
    """exp(100) is infinite in float32, and is not in float64."""
    monkeypatch.setattr(heads, "confidence_of", lambda c: 1 + c.exp())
    assert failures("depth activation", "saturated", "float32") > 0


def test_a_norm_without_its_epsilon_is_reported(monkeypatch):
    """Tokens of 0 have no direction."""
    for head in heads._HEADS.values():
        monkeypatch.setattr(head.norm, "eps", 0.0)
    assert failures("dense head", "zero_features", "float32") > 0


def test_tiles_from_back_to_front_are_reported(monkeypatch):
    """The order of the splats of a tile is that of their depths."""
    right = backend.scatter

    def reversed_(first, last, shifts, depths, *rest):
        with np.errstate(all="ignore"):
            return right(first, last, shifts, (1 / depths).astype(np.float32), *rest)

    monkeypatch.setattr(backend, "scatter", reversed_)
    assert failures("compositing", "ordinary", "float32") > 0
