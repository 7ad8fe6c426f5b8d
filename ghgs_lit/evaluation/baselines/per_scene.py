"""Per-scene 3D Gaussian splatting: each subject's Gaussians are fitted to its own photographs alone."""

from dataclasses import dataclass

from ghgs_lit.evaluation.baselines.splats import photo_depth, splats_at
from ghgs_lit.evaluation.measure import Estimate, Renderer
from ghgs_lit.prediction.refinement import Change, Refinement
from ghgs_lit.types import Batch, Gaussians

#: How far a Gaussian may go and how fast, tuned on four people with 3 to 5 views for what other cameras see.
#: Colours stay near the photograph: freed to 0.1 and beyond they cost 0.2 to 1 dB there.
CHANGES = {
    "means": Change(limit=30.0, rate=0.5),
    "quaternions": Change(limit=1.0, rate=0.05),
    "scales": Change(limit=2.0, rate=0.02),
    "opacities": Change(limit=7.0, rate=0.1),
    "colors": Change(limit=0.05, rate=0.001),
}
#: Standard deviation in pixels and opacity of Gaussians that are not fitted yet.
SIGMA, OPACITY = 0.5, 0.5


@dataclass(frozen=True)
class PerScene:
    """``method(batch)``: 3D Gaussian splatting (Kerbl et al. 2023) on the inputs, a Gaussian for each pixel.

    They begin where photographs agree. None is added or pruned: a Gaussian for each pixel of each photograph
    is more than they can tell apart. ``steps``: of the optimiser, 1 or more.
    """

    renderer: Renderer
    steps: int

    @property
    def fitting(self) -> Refinement:
        """What fits the Gaussians."""
        return Refinement(self.steps, self.renderer, CHANGES)

    def begin(self, batch: Batch) -> Gaussians:
        """The Gaussians that are fitted."""
        depth = photo_depth(batch)
        return splats_at(batch, depth, depth > 0, SIGMA, OPACITY)

    def __call__(self, batch: Batch) -> Estimate:
        gaussians = self.fitting(self.begin(batch), batch)
        image = self.renderer(gaussians, batch.targets.cameras).image
        return Estimate(image, gaussians=gaussians.splits)
