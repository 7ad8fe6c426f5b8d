"""A batch and its plan as inputs of a captured graph: tensors, and constants of their shape bucket.

Shapes of the work after a plan (:mod:`ghgs_lit.method.plan`) depend on its sizes alone, which on a GPU
are shape buckets: every batch of a bucket launches the same kernels."""

from dataclasses import dataclass

from jaxtyping import Bool
from torch import Tensor

from ghgs_lit.execution.preprocessing import strip_targets
from ghgs_lit.extents import Extent
from ghgs_lit.method.plan import Plan, Sizes
from ghgs_lit.method.plan.patches import KeptPatches
from ghgs_lit.types import Batch, DecodedPixels


@dataclass(frozen=True)
class Scene:
    """The parts of a batch and its plan that the stages read."""

    batch: Batch
    shown: Bool[Tensor, "B V h w"]
    kept: Bool[Tensor, "B V h w"] | None
    extents: tuple[Extent, ...]
    shown_extents: tuple[Extent, ...]
    patch_size: int
    pixels: DecodedPixels
    tokens: DecodedPixels
    sizes: Sizes
    has_skew: bool

    @classmethod
    def of(cls, batch: Batch, plan: Plan) -> "Scene":
        """Collect the inputs of the stages; fields that only losses read are left out."""
        kept = None if plan.kept.is_whole else plan.kept.mask
        facts = (plan.patch_size, plan.pixels, plan.tokens, plan.sizes, batch.cameras.has_skew)
        return cls(strip_targets(batch), plan.shown, kept, *plan.bucket_extents(), *facts)

    def read(self) -> tuple[Batch, Plan]:
        """Rebuild the batch and its plan without reading values of tensors."""
        batch = strip_targets(self.batch)
        facts = (self.extents, self.shown_extents, self.patch_size, self.pixels, self.tokens, (), self.sizes)
        device = self.shown.device
        if self.kept is None:
            kept = KeptPatches.whole(self.shown.shape, device)
        else:
            kept = KeptPatches(self.kept, device, size=self.sizes.kept)
        plan = Plan(batch.masks, self.shown, kept, *facts)
        batch.note(plan.extents, lambda: plan.subject.index, self.has_skew)
        return batch, plan
