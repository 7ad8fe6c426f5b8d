"""The whole method as one module: photographs in, Gaussians out (paper, section 3)."""

import dataclasses
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ghgs_lit.batch_checks import check_batch
from ghgs_lit.bounds import NoBounds
from ghgs_lit.config import build
from ghgs_lit.encoder import FeatureCache, VGGTEncoder
from ghgs_lit.errors import InputError, choice, require
from ghgs_lit.geometry.crop import crops_to_subject, pad_to_patches
from ghgs_lit.geometry.groups import Group, join_groups, select_elements
from ghgs_lit.geometry.unprojection import Unprojection
from ghgs_lit.heads.depth import DepthHead
from ghgs_lit.heads.gaussian import GaussianHead
from ghgs_lit.kernels.precision import PRECISIONS, precision_of
from ghgs_lit.recalibration import Recalibration
from ghgs_lit.skipping import AutoSkip, auto_skip, seeing
from ghgs_lit.types import Batch, Decision, DepthBounds, Prediction, Tokens
from ghgs_lit.weights.checkpoint import model_state, read_checkpoint, require_finite, require_fit
from ghgs_lit.weights.reading import cast

#: Stages with weights whose widths follow the encoder's.
HEADS = ("depth_head", "recalibration", "gaussian_head")

#: The nodes of a configuration that :meth:`GHGS.from_config` builds, in the order of the data flow.
STAGES = ("bounds", "encoder", "depth_head", "unprojection", "recalibration", "gaussian_head")


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
        crop: let the stages see crops around the subject; the prediction is that of whole photographs.
        pad: ``multiple`` gives photographs of any size a black border up to the next multiple of the patch
            size; ``none`` refuses them.
        check_inputs: refuse values that are not finite or out of range (:func:`check_batch`).
        auto: chooses what the stages see of each subject (``skip=auto``); None: ``crop`` and the encoder do.
    """

    def __init__(
        self,
        bounds: Callable[[Batch], DepthBounds | None],
        encoder: VGGTEncoder,
        depth_head: DepthHead,
        unprojection: Unprojection,
        recalibration: Recalibration,
        gaussian_head: GaussianHead,
        crop: bool = False,
        pad: str = "none",
        check_inputs: bool = True,
        auto: AutoSkip | None = None,
    ):
        super().__init__()
        choice("model.pad", pad, ("none", "multiple"))
        has_bounds = not isinstance(bounds, NoBounds)
        expected = "none with depth_head.parameterization=inverse_linear, box or hull with all others"
        found = f"{type(bounds).__name__} with {depth_head.parameterization}"
        require(has_bounds == depth_head.is_bounded, "bounds", expected, found)
        sees_bounds = getattr(encoder, "bounds_input", False)
        require(has_bounds or not sees_bounds, "encoder.bounds_input", "false where bounds is none", True)
        self.bounds = bounds
        self.encoder = encoder
        self.depth_head = depth_head
        self.unprojection = unprojection
        self.recalibration = recalibration
        self.gaussian_head = gaussian_head
        self.crop, self.pad, self.check_inputs, self.auto = crop, pad, check_inputs, auto
        #: Where tokens of a frozen encoder are looked up and kept; None: they are computed each time.
        self.feature_cache: FeatureCache | None = None
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
        """Gaussians, depths and points of a batch.

        Raises:
            InputError: :func:`check_batch` refuses the batch.
        """
        check_batch(batch, self.side_multiple, self.check_inputs)
        # From whole photographs: a crop hides what lies at its border, padding invents something there.
        bounds = self.bounds(batch)
        padding = pad_to_patches(batch.masks, self.encoder.patch_size) if self.pad == "multiple" else None
        if padding is not None:
            batch, bounds = padding.cut_batch(batch), padding.cut_bounds(bounds)
        decisions = () if self.auto is None else self.auto.decide(self, batch.masks)
        with precision_of(self.precision, batch.images.device):
            groups = self._chosen(batch, bounds, decisions) if decisions else self._groups(batch, bounds)
            prediction = join_groups(groups)
        prediction = prediction if padding is None else padding.paste_prediction(prediction)
        return dataclasses.replace(prediction, decisions=decisions)

    def _stages(self, batch: Batch, bounds: DepthBounds | None) -> tuple[Prediction, Tokens]:
        tokens = self.encoder(batch.images, batch.masks, bounds, self.feature_cache)
        tokens = self._in_heads_precision(tokens)
        depth_maps = self.depth_head(tokens, batch, bounds)
        points = self.unprojection(depth_maps, tokens, batch)
        tokens = self.recalibration(tokens, points, batch)
        gaussians = self.gaussian_head(tokens, batch, points, depth_maps)
        return Prediction(gaussians, depth_maps.depth, depth_maps.valid, points, depth_maps), tokens

    def _groups(self, batch: Batch, bounds: DepthBounds | None) -> list[Group]:
        """The stages on whole photographs, or on crops: elements whose crops have one size run together."""
        if not self.crop:
            prediction, tokens = self._stages(batch, bounds)
            everyone = torch.arange(len(batch.masks), device=batch.masks.device)
            return [Group(everyone, prediction, tokens.image)]
        groups = []
        for elements, crop in crops_to_subject(batch.masks, self.encoder.patch_size):
            part, own = select_elements(batch, bounds, elements)
            prediction, tokens = self._stages(crop.cut_batch(part), crop.cut_bounds(own))
            groups.append(Group(elements, crop.paste_prediction(prediction), tokens.image))
        return groups

    def _chosen(self, batch: Batch, bounds: DepthBounds | None, decisions: Sequence[Decision]) -> list[Group]:
        """The stages with the preset of each element; elements of one preset run together."""
        groups = []
        for name, preset in self.auto.presets.items():
            chosen = [b for b, decision in enumerate(decisions) if decision.preset == name]
            if not chosen:
                continue
            elements = torch.tensor(chosen, device=batch.masks.device)
            with seeing(self, preset.view):
                for group in self._groups(*select_elements(batch, bounds, elements)):
                    groups.append(dataclasses.replace(group, elements=elements[group.elements]))
        return groups

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
            config: with the nodes :data:`STAGES`, and, where they are given, ``skip.crop``, ``skip.choices``,
                ``model.pad`` and ``model.check_inputs``; other keys are ignored.
            empty: stages that are built without storage (on the meta device), for weights to be assigned to.

        Raises:
            InputError: a stage is missing, or a value is impossible; the message starts with the key.
        """
        for name in STAGES:
            require(name in config, name, "a stage of the model", "nothing")
        options, skip = config.get("model") or {}, config.get("skip") or {}

        def stage(name: str, **extra: Any) -> Any:
            with torch.device("meta") if name in empty else nullcontext():
                return build(config[name], name, **extra)

        encoder = stage("encoder")
        return cls(
            stage("bounds"),
            encoder,
            unprojection=stage("unprojection"),
            **{name: stage(name, dim_latent=encoder.dim_latent) for name in HEADS},
            crop=bool(skip.get("crop", False)),
            pad=options.get("pad", "none"),
            check_inputs=options.get("check_inputs", True),
            auto=auto_skip(skip),
        )

    @classmethod
    def from_checkpoint(
        cls, path: str | Path, map_location: Any = "cpu", dtype: torch.dtype | None = None
    ) -> "GHGS":
        """The model of a checkpoint, in evaluation mode; needs no YAML.

        The weights are mapped from the file, not copied.

        Args:
            path: of the checkpoint.
            map_location: device of the model.
            dtype: of the encoder (None: as in the file); the heads are float32 or wider.

        Raises:
            FileNotFoundError: there is no such file.
            InputError: the file is not a checkpoint of this package, or its weights are not finite or do not
                fit its config.
        """
        model = cls.from_config(read_checkpoint(path)["config"], empty=STAGES)
        model.load(path, dtype)
        return model.to(map_location).eval()

    def load(self, path: str | Path, dtype: torch.dtype | None = None) -> None:
        """Take the weights of a checkpoint; arguments and errors as in :meth:`from_checkpoint`."""
        checkpoint = read_checkpoint(path)
        require_fit(self, model_state(checkpoint), path)
        self.check_preset(checkpoint, path)

        def precision(name: str, stored: torch.dtype) -> torch.dtype:
            if name.startswith("encoder."):
                return dtype or stored
            return torch.promote_types(stored, torch.float32)

        state = cast(lambda: model_state(read_checkpoint(path)), precision)
        require_finite(state, path)
        self.load_state_dict(state, assign=True)

    def check_preset(self, checkpoint: Mapping[str, Any], path: str | Path) -> None:
        """Compare what the stages see with what the weights of a checkpoint have seen.

        ``skip=auto`` leaves out presets that the training did not show; crops with the authors' weights give
        a warning.

        Raises:
            InputError: ``skip=auto`` with the authors' weights.
        """
        if "release" in (checkpoint.get("imported") or {}):
            expected = "skip=none or skip=exact"
            unknown = "whose error is not known for the authors' weights (scales moved by 17 % in a trial)"
            if self.auto is not None:
                raise InputError(f"{path}: expected {expected}; found auto, which takes crops, {unknown}")
            if self.crop:
                warnings.warn(f"{path}: expected {expected}; found crops, {unknown}", stacklevel=3)
        elif self.auto is not None:
            self.auto = self.auto.trained_by(checkpoint["config"])
