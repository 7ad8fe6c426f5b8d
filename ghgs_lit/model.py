"""The whole method as one module: photographs in, Gaussians out (paper, section 3)."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ghgs_lit.bounds import NoBounds
from ghgs_lit.config import build
from ghgs_lit.encoder import FeatureCache, VGGTEncoder
from ghgs_lit.errors import choice, require
from ghgs_lit.geometry.crop import crop_to_subject, pad_to_patches
from ghgs_lit.geometry.unprojection import Unprojection
from ghgs_lit.heads.depth import DepthHead
from ghgs_lit.heads.gaussian import GaussianHead
from ghgs_lit.kernels.precision import PRECISIONS, precision_of
from ghgs_lit.recalibration import Recalibration
from ghgs_lit.types import Batch, DepthBounds, Prediction, Tokens
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
        self.crops = [pad_to_patches] * (pad == "multiple") + [crop_to_subject] * crop
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

    def forward(self, batch: Batch) -> Prediction:
        """Gaussians, depths and points of a batch.

        Raises:
            InputError: :func:`check_batch` refuses the batch.
        """
        patch = self.encoder.patch_size
        check_batch(batch, 1 if pad_to_patches in self.crops else patch)
        # From whole photographs: a crop hides what lies at its border, padding invents something there.
        bounds = self.bounds(batch)
        crops = []
        for crop_of in self.crops:
            crop = crop_of(batch.masks, patch)
            if crop is not None:
                batch, bounds = crop.cut_batch(batch), crop.cut_bounds(bounds)
                crops.append(crop)
        with precision_of(self.precision, batch.images.device):
            tokens = self.encoder(batch.images, batch.masks, bounds, self.feature_cache)
            tokens = self._in_heads_precision(tokens)
            depth_maps = self.depth_head(tokens, batch, bounds)
            points = self.unprojection(depth_maps, tokens, batch)
            tokens = self.recalibration(tokens, points, batch)
            gaussians = self.gaussian_head(tokens, batch, points, depth_maps)
        prediction = Prediction(gaussians, depth_maps.depth, depth_maps.valid, points, depth_maps)
        for crop in reversed(crops):
            prediction = crop.paste_prediction(prediction)
        return prediction

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
            config: with the nodes :data:`STAGES`, and, where they are given, ``skip.crop`` and ``model.pad``;
                other keys are ignored.
            empty: stages that are built without storage (on the meta device), for weights to be assigned to.

        Raises:
            InputError: a stage is missing, or a value is impossible; the message starts with the key.
        """
        for name in STAGES:
            require(name in config, name, "a stage of the model", "nothing")

        def stage(name: str, **extra: Any) -> Any:
            with torch.device("meta") if name in empty else nullcontext():
                return build(config[name], name, **extra)

        encoder = stage("encoder")
        return cls(
            stage("bounds"),
            encoder,
            unprojection=stage("unprojection"),
            **{name: stage(name, dim_latent=encoder.dim_latent) for name in HEADS},
            crop=bool((config.get("skip") or {}).get("crop", False)),
            pad=(config.get("model") or {}).get("pad", "none"),
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
        require_fit(self, model_state(read_checkpoint(path)), path)

        def precision(name: str, stored: torch.dtype) -> torch.dtype:
            if name.startswith("encoder."):
                return dtype or stored
            return torch.promote_types(stored, torch.float32)

        state = cast(lambda: model_state(read_checkpoint(path)), precision)
        require_finite(state, path)
        self.load_state_dict(state, assign=True)


def check_batch(batch: Batch, patch_size: int) -> None:
    """Refuse a batch that the stages cannot work on.

    Args:
        batch: the inputs; targets are not looked at.
        patch_size: must divide height and width, in pixels.

    Raises:
        InputError: names the field, what was expected and what was found.
    """
    require(batch.images.dim() == 5, "batch.images", "[B, V, 3, H, W]", tuple(batch.images.shape))
    b, v, _, height, width = batch.images.shape
    require(v >= 2, "batch.images", "2 views or more", v)
    divisible = height % patch_size == width % patch_size == 0
    expected = f"sides divisible by the patch size {patch_size} (or model.pad=multiple)"
    require(divisible, "batch.images", expected, (height, width))
    require(
        batch.masks.shape == (b, v, height, width),
        "batch.masks",
        str((b, v, height, width)),
        tuple(batch.masks.shape),
    )
    cameras = batch.cameras
    require(cameras.shape == (b, v), "batch.cameras", f"cameras of shape {(b, v)}", tuple(cameras.shape))
    size = (cameras.height, cameras.width)
    require(size == (height, width), "batch.cameras", f"the images' size {(height, width)}", size)
    for name in ("intrinsics", "extrinsics"):
        finite = getattr(cameras, name).isfinite().flatten(2).all(-1)
        require(bool(finite.all()), f"batch.cameras.{name}", "finite values", _where(~finite))
    positive = (cameras.intrinsics[..., [0, 1], [0, 1]] > 0).all(-1)
    require(bool(positive.all()), "batch.cameras.intrinsics", "focal lengths above 0", _where(~positive))
    seen = batch.masks.flatten(1).any(1)
    require(bool(seen.all()), "batch.masks", "the subject in one view at least", _where(~seen))


def _where(bad: torch.Tensor) -> str:
    return f"others at {bad.nonzero().tolist()} (element, view)"
