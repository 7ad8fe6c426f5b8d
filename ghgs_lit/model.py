"""The whole method as one module: photographs in, Gaussians out (paper, section 3)."""

import dataclasses
import warnings
from collections.abc import Callable, Collection, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ghgs_lit.batch_checks import check_batch
from ghgs_lit.bounds import NoBounds
from ghgs_lit.config import build
from ghgs_lit.encoder import FeatureCache, PhotographCache, VGGTEncoder
from ghgs_lit.errors import choice, require
from ghgs_lit.geometry.frame import Frame
from ghgs_lit.geometry.mattes import with_matte
from ghgs_lit.geometry.padding import pad_to_patches
from ghgs_lit.geometry.unprojection import Unprojection
from ghgs_lit.heads.depth import DepthHead
from ghgs_lit.heads.gaussian import GaussianHead
from ghgs_lit.kernels.precision import PRECISIONS, fast_precision, precision_of
from ghgs_lit.recalibration import Recalibration
from ghgs_lit.rounds import Rounds, State
from ghgs_lit.skipping import AutoSkip, auto_skip
from ghgs_lit.types import Batch, DepthBounds, Prediction, Tokens
from ghgs_lit.weights.checkpoint import model_state, read_checkpoint, require_finite, require_fit
from ghgs_lit.weights.reading import SHIPPED, cast

#: Stages with weights whose widths follow the encoder's.
HEADS = ("depth_head", "recalibration", "gaussian_head")

#: The nodes of a configuration that :meth:`GHGS.from_config` builds, in the order of the data flow.
STAGES = ("bounds", "encoder", "depth_head", "unprojection", "recalibration", "gaussian_head")

#: Nodes that a model may have beside them.
OPTIONS = ("rounds", "skip", "model")


class GHGS(nn.Module):
    """``model(batch) -> Prediction``: bounds, encode, depth, unproject, recalibrate, Gaussians.

    Args:
        bounds: near and far of each pixel; :class:`NoBounds` goes with
            ``depth_head.parameterization=inverse_linear``, any other with all other parameterizations.
        encoder: photographs to tokens.
        depth_head: tokens to depths.
        unprojection: depths to world points.
        recalibration: tokens to tokens by multi-view semantic consistency.
        gaussian_head: tokens to Gaussians.
        pad: ``multiple`` gives photographs of any size a black border up to the next multiple of the patch
            size; ``none`` refuses them.
        frame: ``subject`` gives the stages each scene in metres around its subject, whatever the world's
            unit, origin and axes (:mod:`ghgs_lit.geometry.frame`); ``world`` as it is.
        matte: pixels that show a larger share of the subject become Gaussians, whose colours and opacities
            know that share (:mod:`ghgs_lit.geometry.mattes`); None: mattes are ignored.
        check_inputs: refuse values that are not finite or out of range (:func:`check_batch`).
        auto: chooses what the encoder sees of each subject (``skip=auto``); None: it does itself.
        rounds: correct the Gaussians; None: those of the Gaussian head are the result. They need bounds.
    """

    def __init__(
        self,
        bounds: Callable[[Batch], DepthBounds | None],
        encoder: VGGTEncoder,
        depth_head: DepthHead,
        unprojection: Unprojection,
        recalibration: Recalibration,
        gaussian_head: GaussianHead,
        pad: str = "none",
        frame: str = "subject",
        matte: float | None = None,
        check_inputs: bool = True,
        auto: AutoSkip | None = None,
        rounds: Rounds | None = None,
    ):
        super().__init__()
        choice("model.pad", pad, ("none", "multiple"))
        choice("model.frame", frame, ("subject", "world"))
        require(matte is None or 0 <= matte <= 0.5, "model.matte", "null or a share of at most a half", matte)
        has_bounds = not isinstance(bounds, NoBounds)
        expected = "none with depth_head.parameterization=inverse_linear, box or hull with all others"
        found = f"{type(bounds).__name__} with {depth_head.parameterization}"
        require(has_bounds == depth_head.is_bounded, "bounds", expected, found)
        sees_bounds = getattr(encoder, "bounds_input", False)
        require(has_bounds or not sees_bounds, "encoder.bounds_input", "false where bounds is none", True)
        require(rounds is None or has_bounds, "rounds", "a model with bounds", "bounds=none")
        self.bounds = bounds
        self.encoder = encoder
        self.depth_head = depth_head
        self.unprojection = unprojection
        self.recalibration = recalibration
        self.rounds = rounds
        self.gaussian_head = gaussian_head
        self.pad, self.frame, self.matte, self.check_inputs, self.auto = pad, frame, matte, check_inputs, auto
        #: Where features of a frozen encoder are looked up and kept; None: they are computed each time.
        self.feature_cache: FeatureCache | PhotographCache | None = None
        #: Whether predictions outside of training hold the Gaussians before each round, too.
        self.keeps_drafts = False
        self.precision = "inherit"

    @property
    def precision(self) -> str:
        """Of the stages' matrix products: one of :data:`ghgs_lit.kernels.precision.PRECISIONS`."""
        return self._precision

    @precision.setter
    def precision(self, name: str) -> None:
        choice("precision", name, PRECISIONS)
        self._precision = name

    @property
    def side_multiple(self) -> int:
        """What height and width of photographs must be divisible by, in pixels."""
        return 1 if self.pad == "multiple" else self.encoder.patch_size

    def forward(self, batch: Batch) -> Prediction:
        """Gaussians, depths and points of a batch, in the world of its cameras.

        Raises:
            InputError: :func:`check_batch` refuses the batch.
        """
        check_batch(batch, self.side_multiple, self.check_inputs)
        batch = with_matte(batch, self.matte)
        if self.frame == "world":
            return self._predict(batch)
        frame = Frame.of(batch)
        return frame.leave(self._predict(frame.enter(batch)), batch.cameras.extrinsics.dtype)

    def _predict(self, batch: Batch) -> Prediction:
        """:meth:`forward` of a batch in the frame of the stages."""
        # From the photographs: padding invents something at their border.
        bounds = self.bounds(batch)
        padding = pad_to_patches(batch.masks, self.encoder.patch_size) if self.pad == "multiple" else None
        if padding is not None:
            batch, bounds = padding.pad_batch(batch), padding.pad_bounds(bounds)
        decisions, kept = ((), None) if self.auto is None else self.auto.decide(self.encoder, batch.masks)
        with precision_of(self.precision, batch.images.device):
            tokens = self.encoder(batch.images, batch.masks, bounds, self.feature_cache, kept)
            tokens = self._in_heads_precision(tokens)
            depth_maps = self.depth_head(tokens, batch, bounds)
            points = self.unprojection(depth_maps, tokens, batch)
            tokens = self.recalibration(tokens, points)
            raw = self.gaussian_head(tokens, batch, points, depth_maps)
            gaussians = self.gaussian_head.activate(raw, batch, points, depth_maps)
            states = (State(raw, gaussians, points, depth_maps),)
            if self.rounds is not None:
                states = self.rounds(states[0], self.gaussian_head.activate, batch)
        last = states[-1]
        drafts = states[:-1] if self.keeps_drafts and not self.training else ()
        prediction = Prediction(
            last.gaussians,
            last.depth_maps.depth,
            last.depth_maps.valid,
            last.points,
            last.depth_maps,
            decisions,
            rounds=tuple(state.depth_maps for state in states),
            drafts=tuple(state.gaussians for state in drafts),
        )
        return prediction if padding is None else padding.cut_prediction(prediction)

    def _in_heads_precision(self, tokens: Tokens) -> Tokens:
        """Tokens of an encoder whose weights are in half precision, for heads whose weights are not."""
        dtype = next(self.recalibration.parameters()).dtype
        if torch.is_autocast_enabled(tokens.semantic.device.type) or tokens.latent[0].dtype == dtype:
            return tokens
        latent = tuple(layer.to(dtype) for layer in tokens.latent)
        return dataclasses.replace(tokens, latent=latent, semantic=tokens.semantic.to(dtype))

    @classmethod
    def from_config(cls, config: Mapping[str, Any], empty: Collection[str] = ()) -> "GHGS":
        """The model that a configuration describes.

        Args:
            config: with the nodes :data:`STAGES`, and, where they are given, ``skip.choices``, ``model.pad``,
                ``model.frame``, ``model.matte`` and ``model.check_inputs``; other keys are ignored.
            empty: stages that are built without storage (on the meta device), for weights to be assigned to.

        Raises:
            InputError: a stage is missing, or a value is impossible; the message starts with the key.
        """
        for name in STAGES:
            require(name in config, name, "a stage of the model", "nothing")
        options = config.get("model") or {}

        def stage(name: str, **extra: Any) -> Any:
            with torch.device("meta") if name in empty else nullcontext():
                return build(config[name], name, **extra)

        skip = config.get("skip") or {}
        encoder = stage("encoder", tokens=skip.get("tokens", "all"), margin=skip.get("margin", 1))
        return cls(
            stage("bounds"),
            encoder,
            unprojection=stage("unprojection"),
            **{name: stage(name, dim_latent=encoder.dim_latent) for name in HEADS},
            pad=options.get("pad", "none"),
            # Checkpoints from before this option have learned offsets and rotations along the world's axes.
            frame=options.get("frame", "world"),
            matte=options.get("matte"),
            check_inputs=options.get("check_inputs", True),
            auto=auto_skip(skip),
            rounds=stage("rounds", channels=config["gaussian_head"]["channels"])
            if "rounds" in config
            else None,
        )

    @classmethod
    def from_checkpoint(
        cls, path: str | Path = SHIPPED, map_location: Any = "cpu", dtype: torch.dtype | None = None
    ) -> "GHGS":
        """The model of a checkpoint, in evaluation mode; needs no YAML.

        The weights are mapped from the file, not copied.

        Args:
            path: of the checkpoint; that of the package where none is given.
            map_location: device of the model.
            dtype: of the encoder (None: as in the file, on a CPU float32 in place of a half precision that it
                lacks); the heads are float32 or wider.

        Raises:
            FileNotFoundError: there is no such file.
            InputError: the file is not a checkpoint of this package, or its weights are not finite or do not
                fit its config.
        """
        model = cls.from_config(read_checkpoint(path)["config"], empty=STAGES)
        model.load(path, dtype, map_location)
        return model.to(map_location).eval()

    def load(self, path: str | Path, dtype: torch.dtype | None = None, device: Any = "cpu") -> None:
        """Take the weights of a checkpoint.

        Args:
            path, dtype: as for :meth:`from_checkpoint`.
            device: where they will be moved to.

        Raises:
            InputError, FileNotFoundError: as for :meth:`from_checkpoint`.
        """
        checkpoint = read_checkpoint(path)
        require_fit(self, model_state(checkpoint), path)
        self.check_preset(checkpoint, path)

        def precision(name: str, stored: torch.dtype) -> torch.dtype:
            if name.startswith("encoder."):
                return dtype or fast_precision(stored, torch.device(device))
            return torch.promote_types(stored, torch.float32)

        state = cast(lambda: model_state(read_checkpoint(path)), precision)
        require_finite(state, path)
        self.load_state_dict(state, assign=True)

    def check_preset(self, checkpoint: Mapping[str, Any], path: str | Path) -> None:
        """Compare the tokens that take part with those that the training of a checkpoint has shown.

        ``skip=auto`` leaves out presets that it did not show. The authors' training showed all tokens: fewer
        give a warning.
        """
        is_release = "release" in (checkpoint.get("imported") or {})
        if self.auto is not None:
            self.auto = self.auto.trained_by({} if is_release else checkpoint["config"])
        elif is_release and self.encoder.tokens != "all":
            expected = "all, as in the training of the authors' weights"
            found = f"{self.encoder.tokens}, whose error is not known for them"
            warnings.warn(f"{path}: skip.tokens: expected {expected}; found {found}", stacklevel=3)
