"""The whole method as one module, from photographs to Gaussians (paper, section 3)."""

import dataclasses
import functools
import itertools
from collections.abc import Hashable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ghgs_lit.config.registry import build, read_node
from ghgs_lit.errors import choice, require
from ghgs_lit.geometry.padding import bounds_of
from ghgs_lit.method import stages
from ghgs_lit.method.heads.dpt import LEVELS, DPTHead
from ghgs_lit.method.plan import Measured, Plan, Sizes, SkipOptions, planned
from ghgs_lit.method.playback import Entered, Playback
from ghgs_lit.method.rounds import (
    Coarse,
    CoarseDepths,
    Rounds,
    State,
    coarse_of,
    coarse_sizes,
    prediction_of,
    replaced,
    with_known_height,
)
from ghgs_lit.method.stages import HEADS, OPTIONS, STAGES
from ghgs_lit.rendering.capacity import settled
from ghgs_lit.runtime.precision import PRECISIONS, precision_of
from ghgs_lit.surroundings import Finding, ModelOptions, Surrounding, any_bad, entered, left, refuse
from ghgs_lit.types import Batch, DepthBounds, DepthMaps, Prediction, Tokens
from ghgs_lit.weights.checkpoint import load_weights, read_config
from ghgs_lit.weights.reading import SHIPPED


class GHGS(nn.Module):
    """The whole method, ``model(batch) -> Prediction``: the stages of Figure 2 of the paper,
    and rounds.

    Args:
        bounds: near and far of each pixel's ray.
        encoder: photographs to tokens.
        depth_head: tokens to depths.
        unprojection: depths to points in the world.
        recalibration: tokens to tokens, by attention among neighbouring points.
        gaussian_head: tokens and points to Gaussians.
        rounds: correct the Gaussians of the Gaussian head, and need bounds; None: no rounds.
        skip: work to leave out; None: ``skip=exact``.
        options: preparation of photographs around the stages;
            None: as in a configuration that says nothing.

    Raises:
        InputError: a stage needs bounds that there are none of, or the reverse.
    """

    def __init__(
        self,
        bounds: stages.Bounds,
        encoder: stages.Encoder,
        depth_head: stages.DepthHead,
        unprojection: stages.Unprojection,
        recalibration: stages.Recalibration,
        gaussian_head: stages.GaussianHead,
        rounds: Rounds | None = None,
        skip: SkipOptions | None = None,
        options: ModelOptions | None = None,
    ):
        super().__init__()
        stages.require_bounds(bounds, encoder, depth_head, rounds)
        self.bounds = bounds
        self.encoder = encoder
        self.depth_head = depth_head
        self.unprojection = unprojection
        self.recalibration = recalibration
        self.rounds = rounds
        self.gaussian_head = gaussian_head
        self.skip = skip or SkipOptions()
        self.options = options or ModelOptions()
        #: The nodes that :meth:`from_config` built the model from; empty if the stages were given.
        self.config: dict[str, Any] = {}
        #: Predictions that were recorded; nothing of it is part of a checkpoint.
        self.playback = Playback()
        #: Whether predictions outside of training contain the Gaussians before each round.
        self.keeps_drafts = False
        #: Whether to refuse photographs, depths and bodies with NaN or values out of range.
        self.checks_values = True
        self.precision = "inherit"

    def __setattr__(self, name: str, value: Any) -> None:
        """Refuse a ``precision`` other than :data:`ghgs_lit.runtime.precision.PRECISIONS`."""
        if name == "precision":
            choice("precision", value, PRECISIONS)
        super().__setattr__(name, value)

    def forward(self, batch: Batch) -> Prediction:
        """Gaussians, depths and points in the world of the cameras.

        Args:
            batch: photographs, masks and cameras are read, and mattes and gains if there are any.

        Returns:
            The prediction in the pixels of the photographs,
            in the unit and the axes of the cameras' world.

        Raises:
            InputError: the batch does not fit the stages.
        """
        return self.finished(*self.prepared(batch))

    def prepared(self, batch: Batch, least: Sizes | None = None) -> tuple[Sequence[Surrounding], Batch, Plan]:
        """What precedes the stages.

        Args:
            batch: as of :meth:`forward`.
            least: sizes that the plan keeps as long as they are enough; None: those of the scene.

        Returns:
            The layers around the stages, the batch inside of them, and its plan.

        Raises:
            InputError: the batch does not fit the stages.
        """
        asked = (self.options, self.encoder.patch_size, self.checks_values)

        def enter(batch: Batch) -> Entered:
            around, inside, findings = entered(*asked, batch)
            return around, inside, findings, self.measured(inside, findings)

        if self.options.capture == "auto":
            key = (repr(asked), self.settings(("encoder",)))
            around, *of_batch = self.playback.entered(enter, batch, key)
        else:
            around, *of_batch = enter(batch)
        inside, findings, measured = of_batch
        return around, inside, self.plan(inside, findings, least, measured)

    def finished(self, around: Sequence[Surrounding], batch: Batch, plan: Plan) -> Prediction:
        """The prediction for what is prepared.

        Args:
            around: the layers around the stages.
            batch: inside of them.
            plan: of the batch.
        """
        with self.in_precision(batch.masks.device):
            prediction = self._predicted(batch, plan, self._coarse(batch), around)
        return plan.trimmed(prediction)

    def in_precision(self, device: torch.device) -> AbstractContextManager[None]:
        """The precision of the stages' products on a device, while the context lasts."""
        return precision_of(self.precision, device)

    def needs_copies(self, batch: Batch) -> bool:
        """Whether subjects are so tall that smaller copies of their photographs are predicted, too.

        Args:
            batch: as the stages see it.
        """
        height = None if self.rounds is None else self.rounds.height
        return height is not None and any(coarse_sizes(batch, height, self.encoder.patch_size))

    def measured(self, batch: Batch, findings: Sequence[Finding] = ()) -> Measured:
        """What a plan reads, where it is: a function of tensors.

        Args:
            batch: as the stages see it, with whole patches.
            findings: of its checks, which are to be read, too.
        """
        encoder = self.encoder
        masks = batch.masks
        flags = [batch.cameras.any_skew, *([any_bad(findings)] if findings else [])]
        return Measured.of(masks, encoder.patch_size, encoder.keeps(masks), flags)

    def plan(
        self,
        batch: Batch,
        findings: Sequence[Finding] = (),
        least: Sizes | None = None,
        measured: Measured | None = None,
    ) -> Plan:
        """What the stages work on; a GPU is waited for once.

        Args:
            batch: as the stages see it, with whole patches.
            findings: of its checks, which are read, too.
            least: sizes that are kept as long as they are enough; None: those of the scene.
            measured: of the batch; None: it is measured now.

        Raises:
            InputError: the batch violates one of the checks.
        """
        encoder = self.encoder
        targets = [] if batch.targets is None else [batch.targets.cameras]
        plan = planned(
            batch.masks,
            encoder.patch_size,
            measured or self.measured(batch, findings),
            self.skip.pixels,
            self.recalibration.tokens,
            [cameras.any_skew for cameras in targets],
            least=least,
        )
        has_skew, *others = plan.flags
        if findings and others.pop(0):
            refuse(findings)
        vars(batch.cameras)["has_skew"] = has_skew
        for cameras, has_skew in zip(targets, others, strict=True):
            vars(cameras)["has_skew"] = has_skew
        batch.note(plan.extents, lambda: plan.subject.index)
        return plan

    def _predicted(
        self,
        batch: Batch,
        plan: Plan,
        coarse: Coarse | None,
        around: Sequence[Surrounding] = (),
        keeps_tokens: bool = False,
    ) -> Prediction:
        """:meth:`predict` and what surrounds it, played back where it can be;
        renderings have room enough.

        Args:
            batch: as of :meth:`predict`, as are all others.
            plan: of the batch.
            coarse: what was found in smaller copies.
            around: layers that the prediction leaves.
            keeps_tokens: whether tokens are asked for.
        """

        def predict(*inputs: Any, around: Sequence[Surrounding]) -> Prediction:
            return left(around, self.predict(*inputs, keeps_tokens=keeps_tokens))

        if self.options.capture == "auto" and not self.training and self.playback.fits(batch, plan):
            key = (keeps_tokens, self.settings())
            return self.playback(predict, batch, plan, coarse, around, key)
        return settled(lambda: predict(batch, plan, coarse, around=around))

    def predict(
        self, batch: Batch, plan: Plan, coarse: Coarse | None = None, keeps_tokens: bool = False
    ) -> Prediction:
        """The stages of Figure 2: bounds, tokens, and what is decoded from them.

        Args:
            batch: as the stages see it.
            plan: of the batch.
            coarse: what was found in smaller copies of the photographs; None: there are none.
            keeps_tokens: whether the prediction contains the tokens of the encoder. It is for its
                depths then, and the Gaussians of the last round are left out.
        """
        bounds = self.bounded(batch)
        encode = functools.partial(self.encoded, batch, bounds, plan)
        tokens = encode() if coarse is None else coarse.encoded(plan, encode)
        depths = None if coarse is None else coarse.depths
        prediction = self.decoded(batch, bounds, tokens, plan, depths, not keeps_tokens)
        return dataclasses.replace(prediction, tokens=tokens) if keeps_tokens else prediction

    def bounded(self, batch: Batch) -> DepthBounds | None:
        """Near and far of each pixel's ray; None for stages without bounds."""
        return bounds_of(self.bounds, batch)

    def encoded(self, batch: Batch, bounds: DepthBounds | None, plan: Plan) -> Tokens:
        """Tokens in the precision of the heads, which may differ from that of the encoder.

        Args:
            batch: photographs and masks are read.
            bounds: of all pixels; None for stages without bounds.
            plan: which patches become tokens.
        """
        tokens = self.encoder(batch.images, batch.masks, bounds, plan)
        parameters = itertools.chain.from_iterable(getattr(self, name).parameters() for name in HEADS)
        return tokens.in_precision(next(parameters, tokens.semantic).dtype)

    def decoded(
        self,
        batch: Batch,
        bounds: DepthBounds | None,
        tokens: Tokens,
        plan: Plan,
        coarse: CoarseDepths | None = None,
        shows_last: bool = True,
    ) -> Prediction:
        """What the stages after the encoder make of its tokens, and the rounds of that.

        Args:
            batch: as the stages see it.
            bounds: of all pixels; None for stages without bounds.
            tokens: of the encoder.
            plan: which tokens are recalibrated and which pixels become Gaussians.
            coarse: depths from smaller copies of the photographs; None: there are none.
            shows_last: whether the Gaussians of the last round are wanted.

        Returns:
            The prediction in the world of the stages.
        """
        depth_maps = self._depths(tokens, batch, bounds, plan, coarse)
        points = self.unprojection(depth_maps, tokens, batch)
        tokens = self.recalibration(tokens, points, plan)
        raw = self.gaussian_head(tokens, batch, points, depth_maps, plan)
        activate = self.gaussian_head.activate
        first = replaced(activate, self.training) if self.rounds else activate
        state = State(raw, first(raw, batch, points, depth_maps), points, depth_maps)
        step = 1.0 if coarse is None else coarse.step
        asked = {} if shows_last else {"shows_last": False}  # rounds of one's own may not know it
        states = self.rounds(state, activate, batch, step, **asked) if self.rounds else (state,)
        return prediction_of(states, self.keeps_drafts and not self.training)

    def _depths(
        self,
        tokens: Tokens,
        batch: Batch,
        bounds: DepthBounds | None,
        plan: Plan,
        coarse: CoarseDepths | None,
    ) -> DepthMaps:
        """Depths of the depth head, but the coarse ones of elements that have them.

        Args:
            tokens: of the encoder.
            batch: as the stages see it.
            bounds: of all pixels; None for stages without bounds.
            plan: in which windows depths are needed.
            coarse: depths from smaller copies of the photographs; None: there are none.
        """
        if coarse is not None and coarse.are_all:
            return coarse.maps(batch, bounds)
        maps = self.depth_head(tokens, batch, bounds, plan)
        return maps if coarse is None else coarse.maps(batch, bounds, maps)

    def _coarse(self, batch: Batch) -> Coarse | None:
        """What is found in smaller copies of photographs with subjects taller than the
        rounds know."""
        if self.rounds is None or self.rounds.height is None:
            return None

        def predict(small: Batch) -> Prediction:
            return self._predicted(small, self.plan(small), None, keeps_tokens=True)

        return coarse_of(batch, self.rounds.height, self.encoder.patch_size, self.options.matte, predict)

    def settings(self, parts: Sequence[str] = (*STAGES, "rounds")) -> Hashable:
        """All that may be changed after a model was made and decides what it computes,
        but its weights.

        Args:
            parts: stages that compute.
        """
        settings: list[Hashable] = [self.skip.pixels, self.keeps_drafts, self.precision]
        for name in parts:
            of_stage = getattr(getattr(self, name), "__dict__", {}).items()
            settings += [(name, *item) for item in of_stage if isinstance(item[1], (str, int, float, tuple))]
        return repr(settings)

    def _apply(self, *arguments: Any, **options: Any) -> "GHGS":
        self.playback.clear()  # weights move
        return super()._apply(*arguments, **options)

    def _load_from_state_dict(self, *arguments: Any, **options: Any) -> None:
        self.playback.clear()  # weights may be replaced
        super()._load_from_state_dict(*arguments, **options)

    @classmethod
    def from_config(cls, config: Mapping[str, Any], empty: bool = False) -> "GHGS":
        """The model of a configuration.

        Args:
            config: nodes by their names: all of :data:`ghgs_lit.method.stages.STAGES`,
                and of ``OPTIONS`` there any.
            empty: on the meta device, to be given weights: a strange configuration then takes no
                memory before they are compared with it.

        Raises:
            InputError: a stage is missing, an option is unknown or out of range, or stages do not
                fit each other.
        """
        for name in STAGES:
            require(name in config, name, "a stage of the model", "nothing")
        config = with_known_height(config, config)
        skip, options = (read_node(config.get(name) or {}, name) for name in ("skip", "model"))

        def stage(name: str, **extra: Any) -> Any:
            with torch.device("meta") if empty else nullcontext():
                return build(config[name], name, **extra)

        encoder = stage("encoder", tokens=skip.tokens, margin=skip.margin)
        heads = {name: stage(name, dim_latent=encoder.dim_latent) for name in HEADS}
        # a plug-in's may not say
        layers = getattr(read_node(config["encoder"], "encoder"), "layers", None)
        modules = itertools.chain.from_iterable(head.modules() for head in heads.values())
        fused = any(isinstance(module, DPTHead) for module in modules)
        fits = layers is None or not fused or len(layers) == LEVELS
        require(fits, "encoder.layers", f"{LEVELS} layers, which the dense heads fuse", list(layers or ()))
        rounds = stage("rounds", channels=heads["gaussian_head"].channels) if "rounds" in config else None
        others = {name: stage(name) for name in ("bounds", "unprojection")}
        model = cls(encoder=encoder, **heads, **others, rounds=rounds, skip=skip, options=options)
        model.config = {node: config[node] for node in (*STAGES, *OPTIONS, "compat") if node in config}
        return model

    @classmethod
    def from_checkpoint(
        cls, path: str | Path = SHIPPED, map_location: Any = "cpu", dtype: torch.dtype | None = None
    ) -> "GHGS":
        """The model of a checkpoint in evaluation mode.

        Args:
            path: of a checkpoint of this package; by default the weights that come with it.
            map_location: the device that the model is moved to.
            dtype: precision of the encoder; None: as in the file, where the device has it.
                Heads are float32.

        Raises:
            FileNotFoundError: there is no such file.
            InputError: it is not a checkpoint of this package,
                or its weights are not finite or do not fit.
        """
        model = cls.from_config(read_config(path), empty=True)
        load_weights(model, path, dtype, map_location)
        return model.to(map_location).eval()
