"""The whole method as one module, from input views to Gaussians (paper, section 3)."""

import itertools
import math
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from typing import Any

import torch
from jaxtyping import Bool
from omegaconf import OmegaConf
from torch import Tensor, nn

from ghgs_lit.config.keys import lookup
from ghgs_lit.config.registry import build, read_node
from ghgs_lit.errors import require
from ghgs_lit.geometry.padding import bounds_of
from ghgs_lit.method import stages
from ghgs_lit.method.heads.dpt import LEVELS, DPTHead
from ghgs_lit.method.plan import MaskStatistics, Plan, Sizes, SkipOptions, make_plan
from ghgs_lit.method.rounds import Coarse, NoRounds, Rounds, State, prediction_of
from ghgs_lit.method.rounds.coarse import FILLED
from ghgs_lit.method.stages import HEADS, OPTIONS, STAGES
from ghgs_lit.types import Batch, Prediction, Tokens


class GHGS(nn.Module):
    """The whole method: the stages of Figure 2 of the paper, followed by optional refinement rounds.

    :class:`ghgs_lit.execution.Predictor` preprocesses batches of any world frame and size for it.

    Args:
        bounds: near and far of each pixel's ray.
        encoder: input views to tokens.
        depth_head: tokens to depths.
        unprojection: depths to points in the world.
        recalibration: tokens to tokens, by attention among neighbouring points.
        gaussian_head: tokens and points to Gaussians.
        rounds: refinement of the head's Gaussians, which requires bounds; None: no rounds.
        skip: preset of work to leave out; None: ``skip=exact``.

    Raises:
        InputError: a stage requires bounds, which are None, or vice versa.
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
    ):
        super().__init__()
        stages.require_bounds(bounds, encoder, depth_head, rounds)
        self.bounds = bounds
        self.encoder = encoder
        self.depth_head = depth_head
        self.unprojection = unprojection
        self.recalibration = recalibration
        self.gaussian_head = gaussian_head
        self.rounds = NoRounds() if rounds is None else rounds
        self.skip = skip or SkipOptions()
        #: Nodes that :meth:`from_config` built the model from; empty if it was built otherwise.
        self.config: dict[str, Any] = {}

    def forward(self, batch: Batch, plan: Plan | None = None, coarse: Coarse | None = None) -> Prediction:
        """Predict Gaussians, depths and points in the world of the batch's cameras.

        Args:
            batch: preprocessed: whole patches, in metres around the subject.
            plan: plan of the batch; None: computed here.
            coarse: tokens and depths predicted from downsampled views; None: full resolution only.

        Returns:
            The prediction, with the tokens of the encoder.
        """
        plan = plan or self.plan(batch)
        encoder = self.encoder if coarse is None else coarse.encoder(self.encoder)
        depth_head = self.depth_head if coarse is None else coarse.depth_head(self.depth_head)
        bounds = bounds_of(self.bounds, batch)
        encoded = self._for_heads(encoder(batch.images, batch.masks, bounds, plan))
        depth_maps = depth_head(encoded, batch, bounds, plan)
        points = self.unprojection(depth_maps, encoded, batch)
        tokens = self.recalibration(encoded, points, plan)
        raw = self.gaussian_head(tokens, batch, points, depth_maps, plan)
        state = State(raw, None, points, depth_maps)
        step = 1.0 if coarse is None else coarse.depths.step
        states = self.rounds(state, self.gaussian_head.activate, batch, step)
        return prediction_of(states, encoded)

    def _for_heads(self, tokens: Tokens) -> Tokens:
        """Convert tokens to the dtype of the heads, which may differ from that of the encoder."""
        parameters = itertools.chain.from_iterable(getattr(self, name).parameters() for name in HEADS)
        return tokens.in_precision(next(parameters, tokens.semantic).dtype)

    def measure(self, batch: Batch, flags: Sequence[Bool[Tensor, ""]] = ()) -> MaskStatistics:
        """Compute the mask statistics for :meth:`plan`, as tensors on the device of the masks.

        Args:
            batch: preprocessed.
            flags: further values to copy to the host together with the statistics.
        """
        flags = [batch.cameras.any_skew, *flags]
        return MaskStatistics.of(batch.masks, self.encoder.patch_size, self.encoder.keeps(batch.masks), flags)

    def plan(self, batch: Batch, measured: MaskStatistics | None = None, least: Sizes | None = None) -> Plan:
        """Plan the patches, tokens and pixels that the stages compute.

        This is the only device-to-host synchronisation before the stages.

        Args:
            batch: preprocessed.
            measured: result of :meth:`measure`; None: computed here.
            least: sizes of a shape bucket, reused if they suffice; None: sizes of the scene.
        """
        targets = [] if batch.targets is None else [batch.targets.cameras]
        plan = make_plan(
            batch.masks,
            self.encoder.patch_size,
            measured or self.measure(batch),
            self.skip.pixels,
            self.recalibration.tokens,
            [cameras.any_skew for cameras in targets],
            least=least,
        )
        for cameras in targets:
            cameras.note_skew(plan.flags[-1])
        batch.note(plan.extents, lambda: plan.subject.index, plan.flags[0])
        return plan

    @classmethod
    def from_config(cls, config: Mapping[str, Any], empty: bool = False) -> "GHGS":
        """Build the model of a configuration.

        Args:
            config: nodes by name: all of :data:`ghgs_lit.method.stages.STAGES`, and any of
                :data:`ghgs_lit.method.stages.OPTIONS`.
            empty: build on the meta device, for weights that are loaded afterwards: if these do not fit,
                no memory has been allocated.

        Raises:
            InputError: a stage is missing, an option is unknown or out of range, or stages are
                incompatible.
        """
        config = resolve_height(config, config)
        skip = read_node(config.get("skip") or {}, "skip")
        parts: dict[str, Any] = {}
        with torch.device("meta") if empty else nullcontext():
            for name in STAGES:
                require(name in config, name, "a stage of the model", "nothing")
                extra = {"dim_latent": parts["encoder"].dim_latent} if name in HEADS else {}
                if name == "encoder":
                    extra = {"tokens": skip.tokens, "margin": skip.margin}
                parts[name] = build(config[name], name, **extra)
                for attribute in getattr(stages.INTERFACES[name], "__annotations__", ()):
                    expected = f"a stage with the attribute {attribute}"
                    require(hasattr(parts[name], attribute), name, expected, type(parts[name]).__name__)
            if "rounds" in config:
                parts["rounds"] = build(config["rounds"], "rounds", channels=parts["gaussian_head"].channels)
        # Options of a plug-in's encoder may not name layers.
        layers = getattr(read_node(config["encoder"], "encoder"), "layers", None)
        model = cls(**parts, skip=skip)
        fuses = any(isinstance(module, DPTHead) for module in model.modules())
        fits = layers is None or not fuses or len(layers) == LEVELS
        require(fits, "encoder.layers", f"{LEVELS} layers, which the dense heads fuse", list(layers or ()))
        model.config = {node: config[node] for node in (*STAGES, *OPTIONS, "compat") if node in config}
        return model


def resolve_height(nodes: Mapping[str, Any], trained: Mapping[str, Any]) -> dict[str, Any]:
    """Replace ``rounds.height: auto`` in a model's nodes by a number of pixels; null if sizes are unknown.

    Args:
        nodes: nodes of the model by name, with or without rounds.
        trained: configuration of its training: ``data.size`` and ``augmentation.sizes`` are used.
    """
    rounds = nodes.get("rounds")
    rounds = OmegaConf.to_container(rounds, resolve=True) if OmegaConf.is_config(rounds) else rounds
    # User-defined kinds of rounds are left as they are.
    is_known = isinstance(rounds, Mapping) and rounds.get("kind") == "recurrent"
    if not is_known or rounds.get("height", "auto") != "auto":
        return dict(nodes)
    sides: list[int] = []
    for size in (lookup(trained, "data.size"), *(lookup(trained, "augmentation.sizes") or ())):
        sides += [size] if isinstance(size, int) else size or ()
    return {**nodes, "rounds": {**rounds, "height": math.ceil(FILLED * max(sides)) if sides else None}}
