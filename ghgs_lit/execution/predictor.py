"""Prediction for batches in any world frame and of any image size."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch

from ghgs_lit.errors import require_choice
from ghgs_lit.execution.capture import ModelState, NotCapturable, state_of
from ghgs_lit.execution.graphs import GraphCache, describe_inputs, retry_without_graphs
from ghgs_lit.execution.options import ModelOptions
from ghgs_lit.execution.preprocessing import (
    Finding,
    Preprocessing,
    Scene,
    any_bad,
    preprocess,
    raise_violation,
)
from ghgs_lit.geometry.padding import PaddedBatch
from ghgs_lit.geometry.precision import PRECISIONS, precision_of
from ghgs_lit.method.model import GHGS
from ghgs_lit.method.plan import MaskStatistics, Plan, Sizes
from ghgs_lit.method.rounds import Coarse, coarse_of, coarse_sizes
from ghgs_lit.rendering.capacity import repeat_until_sufficient
from ghgs_lit.types import Batch, Prediction
from ghgs_lit.weights.checkpoint import load_weights, read_config
from ghgs_lit.weights.reading import SHIPPED


class Prepared(NamedTuple):
    """A preprocessed batch and its plan.

    Attributes:
        batch: the preprocessed batch.
        plan: its plan.
        done: its preprocessing.
        state: state of the model for CUDA-graph capture; None: run eagerly.
    """

    batch: Batch
    plan: Plan
    done: Preprocessing
    state: ModelState | None


class Predictor:
    """``predictor(batch) -> Prediction``: a model with checks, the subject's frame, padding, precision,
    coarse to fine, and CUDA graphs.

    Args:
        model: the stages.
        options: options of pre- and postprocessing; None: those of the model's configuration.
        precision: precision of products, one of :data:`ghgs_lit.geometry.precision.PRECISIONS`.

    Attributes:
        graphs: captured graphs, at most two per shape bucket.

    Raises:
        InputError: an option or the precision is unknown.
    """

    def __init__(self, model: GHGS, options: ModelOptions | None = None, precision: str = "inherit"):
        require_choice("precision", precision, PRECISIONS)
        self.model = model
        self.options = options or ModelOptions.read(model.config.get("model") or {}, "model")
        self.precision = precision
        self.graphs = GraphCache(limit=16)

    @classmethod
    def from_checkpoint(
        cls, path: str | Path = SHIPPED, map_location: Any = "cpu", dtype: torch.dtype | None = None
    ) -> "Predictor":
        """Load the predictor of a checkpoint, in evaluation mode.

        Args:
            path: checkpoint of this package; by default the weights that come with it.
            map_location: device to move the model to.
            dtype: dtype of the encoder; None: as in the file, if the device supports it. Heads are
                float32.

        Raises:
            FileNotFoundError: there is no such file.
            InputError: it is not a checkpoint of this package, or its weights are not finite or do not
                fit.
        """
        model = GHGS.from_config(read_config(path), empty=True)
        load_weights(model, path, dtype, map_location)
        return cls(model.to(map_location).eval())

    def __call__(self, batch: Batch) -> Prediction:
        """Predict Gaussians, depths and points.

        Args:
            batch: input views, masks and cameras are read, and mattes and gains if there are any.

        Returns:
            The prediction in the pixels of the input views, in the unit and axes of the cameras' world.

        Raises:
            InputError: the batch is invalid or does not fit the stages.
        """
        return self.finish(self.prepare(batch))

    def prepare(self, batch: Batch, least: Sizes | None = None) -> Prepared:
        """Check, preprocess and plan a batch.

        Args:
            batch: as for :meth:`__call__`.
            least: sizes that the plan reuses if they suffice; None: sizes of the scene.

        Raises:
            InputError: the batch is invalid or does not fit the stages.
        """
        state = self._state(batch)
        inside, done, findings, measured = (
            self._enter(batch) if state is None else self._enter_captured(batch, state)
        )
        plan = self.model.plan(inside, measured, least)
        if plan.flags[1]:
            raise_violation(findings)
        return Prepared(inside, plan, done, state)

    def finish(self, prepared: Prepared) -> Prediction:
        """Predict from a prepared batch."""
        with precision_of(self.precision, prepared.batch.masks.device):
            prediction = self._predict(prepared, self._coarse(prepared))
        return prepared.plan.trim(prediction)

    @property
    def side_multiple(self) -> int:
        """Number of pixels that must divide height and width of input views."""
        return self.options.side_multiple(self.model.encoder.patch_size)

    def needs_copies(self, batch: Batch) -> bool:
        """Whether subjects are so tall that downsampled copies of their views are used.

        Args:
            batch: preprocessed, with extents read by a plan.
        """
        height = self.model.rounds.height
        return height is not None and any(coarse_sizes(batch, height, self.model.encoder.patch_size))

    def _state(self, batch: Batch) -> ModelState | None:
        """State of the model if it can be captured, else None."""
        if batch.masks.device.type != self.graphs.backend.device or self.options.capture == "off":
            return None
        try:
            return self.graphs.of_weights(state_of(self.model))
        except NotCapturable as reason:
            self.graphs.note(str(reason))
            return None

    def _enter(self, batch: Batch) -> tuple[Batch, Preprocessing, list[Finding], MaskStatistics]:
        patch_size = self.model.encoder.patch_size
        inside, done, findings = preprocess(batch, self.options, patch_size)
        return inside, done, findings, self.model.measure(inside, [any_bad(findings)])

    def _enter_captured(
        self, batch: Batch, state: ModelState
    ) -> tuple[Batch, Preprocessing, list[Finding], MaskStatistics]:
        """:meth:`_enter`, captured unless a gradient is required."""
        tensors: list[torch.Tensor] = []
        describe_inputs(batch, tensors)
        if any(tensor.requires_grad for tensor in tensors):
            return self._enter(batch)
        # Fresh cameras: cached values would put the same batch into another bucket the next time.
        bare = replace(batch, cameras=replace(batch.cameras), targets=None, subjects=(), views=())
        key = ("enter", self.options, state.settings)
        with torch.no_grad():
            inside, *others = self.graphs(self._enter, bare, key)
        # Targets and names are not preprocessed.
        return replace(inside, targets=batch.targets, subjects=batch.subjects, views=batch.views), *others

    def _predict(self, prepared: Prepared, coarse: Coarse | None) -> Prediction:
        """Run the stages and postprocessing, repeated until renderings have enough capacity."""
        batch, plan, done, state = prepared

        def predict(
            batch: Batch, plan: Plan, coarse: Coarse | None, done: Preprocessing | None
        ) -> Prediction:
            prediction = self.model(batch, plan, coarse)
            return prediction if done is None else done.undo(prediction)

        is_eager = state is None or self.model.training or torch.is_grad_enabled()
        if is_eager or not self.fits(batch, plan):
            return retry_without_graphs(
                partial(repeat_until_sufficient, partial(predict, batch, plan, coarse, done))
            )
        return self.graphs.repeat_until_sufficient(
            lambda inputs: predict(*inputs[0].read(), *inputs[1:]),
            (Scene.of(batch, plan), coarse, done),
            (self.precision, state.settings),
        )

    def fits(self, batch: Batch, plan: Plan) -> bool:
        """Whether the stages can be captured for a preprocessed batch with its plan; logs why not."""
        if type(batch) not in (Batch, PaddedBatch):
            self.graphs.note(f"a batch of the class {type(batch).__name__}")
        elif not plan.is_bucket:
            self.graphs.note("subjects of fewer pixels than views")
        else:
            return True
        return False

    def _coarse(self, prepared: Prepared) -> Coarse | None:
        """Predict from downsampled views if subjects are taller than in training."""
        model = self.model
        if model.rounds.height is None:
            return None

        def predict(small: Batch) -> Prediction:
            return self._predict(Prepared(small, model.plan(small), None, prepared.state), None)

        sizes = (model.rounds.height, model.encoder.patch_size, self.options.matte)
        return coarse_of(prepared.batch, *sizes, predict)
