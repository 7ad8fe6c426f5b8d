"""A batch and its plan as inputs of a captured graph: tensors, and numbers of their shape bucket.

What follows a plan (:mod:`ghgs_lit.method.plan`) depends on sizes alone, and on a GPU these are
buckets. So the work is the same for every batch of a bucket."""

from dataclasses import dataclass

from jaxtyping import Bool
from torch import Tensor

from ghgs_lit.execution.preprocessing import without_targets
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
        """The inputs that the stages read; what only losses read is left out."""
        kept = None if plan.kept.is_whole else plan.kept.mask
        facts = (plan.patch_size, plan.pixels, plan.tokens, plan.sizes, batch.cameras.has_skew)
        return cls(without_targets(batch), plan.shown, kept, *plan.bucket_extents(), *facts)

    def read(self) -> tuple[Batch, Plan]:
        """A batch and its plan, for which no value of a tensor is needed."""
        batch = without_targets(self.batch)
        facts = (self.extents, self.shown_extents, self.patch_size, self.pixels, self.tokens, (), self.sizes)
        device = self.shown.device
        if self.kept is None:
            kept = KeptPatches.whole(self.shown.shape, device)
        else:
            kept = KeptPatches(self.kept, device, size=self.sizes.kept)
        plan = Plan(batch.masks, self.shown, kept, *facts)
        batch.note(plan.extents, lambda: plan.subject.index, self.has_skew)
        return batch, plan
