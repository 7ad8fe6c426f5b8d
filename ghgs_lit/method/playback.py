"""Predictions whose work is recorded on a GPU for each class of scenes, and played back.

What follows a plan (:mod:`ghgs_lit.method.plan`) depends on sizes alone, and on a GPU these are size
classes. So what precedes the plan, and the stages after it, are the same work for every batch of a
class. Recorded once as CUDA graphs (:mod:`ghgs_lit.runtime.recording`), each starts at once instead
of by thousands of calls."""

import dataclasses
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from ghgs_lit.extents import Extent
from ghgs_lit.method.plan import Measured, Plan, Sizes
from ghgs_lit.method.plan.patches import KeptPatches
from ghgs_lit.method.rounds import Coarse
from ghgs_lit.rendering.capacity import Rooms, deferred
from ghgs_lit.runtime.recording import Recorder, described
from ghgs_lit.runtime.watching import is_watched
from ghgs_lit.surroundings import Finding, Surrounding
from ghgs_lit.types import Batch, DecodedPixels, Prediction

#: Layers around the stages, the batch inside of them, what is expected of its values,
#: and what a plan reads of it.
Entered = tuple[Sequence[Surrounding], Batch, list[Finding], Measured]


#: What all stages make of a batch as they see it, of its plan, and of what was found in smaller
#: copies of the photographs (None: there are none), outside of the layers ``around``.
Predict = Callable[..., Prediction]


@dataclass(frozen=True)
class Scene:
    """What the stages read of a batch and its plan, as inputs of a recording: tensors, and numbers
    of the class."""

    batch: Batch
    shown: Bool[Tensor, "B V h w"]
    kept: Bool[Tensor, "B V h w"] | None
    extents: tuple[Extent, ...]
    shown_extents: tuple[Extent, ...]
    patch_size: int
    pixels: DecodedPixels
    tokens: DecodedPixels
    sizes: Sizes

    @classmethod
    def of(cls, batch: Batch, plan: Plan) -> "Scene":
        """The inputs that the stages read; what only losses read is left out."""
        bare = dataclasses.replace(batch, targets=None, body_vertices=None, subjects=(), views=())
        kept = None if plan.kept.is_whole else plan.kept.mask
        facts = (plan.patch_size, plan.pixels, plan.tokens, plan.sizes)
        return cls(bare, plan.shown, kept, *plan.extents_of_class(), *facts)

    def read(self) -> tuple[Batch, Plan]:
        """A batch and its plan, for which no value of a tensor is needed."""
        batch = dataclasses.replace(self.batch, cameras=dataclasses.replace(self.batch.cameras))
        facts = (self.extents, self.shown_extents, self.patch_size, self.pixels, self.tokens, True)
        device = self.shown.device
        if self.kept is None:
            kept = KeptPatches.whole(self.shown.shape, device)
        else:
            kept = KeptPatches(self.kept, device, size=self.sizes.kept)
        plan = Plan(batch.masks, self.shown, kept, *facts, least=self.sizes, is_least=True)
        batch.note(plan.extents, lambda: plan.subject.index)
        vars(batch.cameras)["has_skew"] = False
        return batch, plan


class Playback:
    """Predictions of a model, played back where they can be.

    Args:
        recorder: makes and keeps recordings, two for each class of scenes; None: one that keeps 16.
        steps: the same of training steps (:mod:`ghgs_lit.training.captured`), one for each class.

    Attributes:
        sizes: those of training steps so far,
            by the shape of their photographs and what their encoder sees.
    """

    def __init__(self, recorder: Recorder | None = None, steps: Recorder | None = None):
        self.recorder = recorder or Recorder(limit=16)
        self.steps = steps or Recorder(limit=32, recent=8)
        self.sizes: dict[Hashable, Sizes] = {}

    def clear(self) -> None:
        """Forget all recordings: after weights have moved."""
        self.recorder.clear()
        self.steps.clear()

    def entered(self, enter: Callable[[Batch], Entered], batch: Batch, key: Hashable) -> Entered:
        """What precedes the plan, played back where no gradient is wanted;
        its work depends on sizes alone.

        Args:
            enter: gives layers around the stages, the batch inside of them, findings, and what a
                plan reads.
            batch: outside of all layers.
            key: all that ``enter`` depends on.
        """
        here = type(batch) is Batch and batch.masks.device.type == self.recorder.tape.device
        tensors: list[Tensor] = []
        described(batch, tensors)
        if not here or is_watched() or any(tensor.requires_grad for tensor in tensors):
            return enter(batch)
        # Without what was computed of the cameras,
        # or the same batch would be of another class the next time.
        cameras = dataclasses.replace(batch.cameras)
        bare = dataclasses.replace(batch, cameras=cameras, targets=None, subjects=(), views=())
        with torch.no_grad():
            around, inside, findings, measured = self.recorder(enter, bare, ("entered", key))
        # Targets and names take no part; what was computed of the batch stays with it.
        vars(inside).update(targets=batch.targets, subjects=batch.subjects, views=batch.views)
        return around, inside, findings, measured

    def fits(self, batch: Batch, plan: Plan) -> bool:
        """Whether recordings of this batch are worth a try.

        Args:
            batch: as the stages see it.
            plan: of the batch.

        Returns:
            True where its sizes are those of a class, on a device that records,
            and no gradient is wanted.
        """
        return self.repeats(batch, plan) and not torch.is_grad_enabled()

    def repeats(self, batch: Batch, plan: Plan) -> bool:
        """:meth:`fits`, with or without a gradient."""
        here = batch.masks.device.type == self.recorder.tape.device
        sized = type(batch) is Batch and plan.is_of_class and plan.kept.is_even
        return here and sized and not is_watched()

    def __call__(
        self,
        predict: Predict,
        batch: Batch,
        plan: Plan,
        coarse: Coarse | None,
        around: Sequence[Surrounding],
        key: Hashable,
    ) -> Prediction:
        """The prediction for a batch that :meth:`fits`.

        Args:
            predict: of the model.
            batch: as the stages see it.
            plan: of the batch.
            coarse: what was found in smaller copies, if there are any.
            around: layers that the prediction leaves.
            key: all else that the prediction depends on, but weights that stay where they are.

        Returns:
            The prediction; its Gaussians fill their size class.
        """

        def predicted(inputs: tuple) -> tuple[Prediction, Rooms]:
            scene, coarse, around = inputs
            with deferred() as rooms:
                return predict(*scene.read(), coarse, around=around), rooms

        inputs = (Scene.of(batch, plan), coarse, tuple(around))
        prediction, rooms = self.recorder(predicted, inputs, key)
        while not rooms.suffice():
            self.recorder.forget(inputs, key)
            prediction, rooms = self.recorder(predicted, inputs, key)
        return prediction
