"""The whole method as one module: photographs in, Gaussians out (paper, section 3)."""

import dataclasses
from collections.abc import Collection, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ghgs_lit.bounds.visual_hull import Interval
from ghgs_lit.config import build
from ghgs_lit.encoder import VGGTEncoder
from ghgs_lit.errors import choice, require
from ghgs_lit.geometry.crop import patch_padding, subject_windows
from ghgs_lit.geometry.unprojection import Unprojection
from ghgs_lit.heads.depth import DepthHead
from ghgs_lit.heads.gaussian import GaussianHead
from ghgs_lit.kernels.precision import precision_of
from ghgs_lit.recalibration import Recalibration
from ghgs_lit.types import Batch, Prediction, Tokens
from ghgs_lit.weights.checkpoint import (
    FORMAT_VERSION,
    STATE_PREFIX,
    load_strictly,
    model_state,
    read_checkpoint,
    require_fit,
)
from ghgs_lit.weights.reading import cast

__all__ = [
    "FORMAT_VERSION",
    "GHGS",
    "STAGES",
    "STATE_PREFIX",
    "check_batch",
    "load_strictly",
    "read_checkpoint",
]

STAGES = ("encoder", "depth_head", "recalibration", "gaussian_head")


class GHGS(nn.Module):
    """Encode, predict depth, unproject, recalibrate, regress Gaussians: ``model(batch) -> Prediction``.

    With ``pad="multiple"`` photographs of any size get a black border up to the next multiple of the
    patch size. With ``crop`` the stages see windows around the subject in place of the whole photographs.
    What comes back is that of the whole photographs.
    """

    def __init__(
        self,
        encoder: VGGTEncoder,
        depth_head: DepthHead,
        recalibration: Recalibration,
        gaussian_head: GaussianHead,
        unprojection: Unprojection | None = None,
        crop: bool = False,
        pad: str = "none",
    ):
        super().__init__()
        choice("model.pad", pad, ("none", "multiple"))
        require(
            depth_head.bounds is not None or not getattr(encoder, "interval_input", False),
            "encoder.interval_input",
            "false where depth_head.bounds is none",
            True,
        )
        self.encoder = encoder
        self.depth_head = depth_head
        self.unproject = unprojection or Unprojection()
        self.recalibration = recalibration
        self.gaussian_head = gaussian_head
        #: Of the stages' products: one of :data:`ghgs_lit.kernels.precision.PRECISIONS`.
        self.precision = "inherit"
        self.frames = [patch_padding] * (pad == "multiple") + [subject_windows] * crop

    def forward(self, batch: Batch) -> Prediction:
        patch = self.encoder.patch_size
        check_batch(batch, 1 if patch_padding in self.frames else patch)
        # From the whole photographs: a frame hides from the hull, or invents, what lies at its border.
        interval = self.depth_head.interval(batch)
        used = []
        for frame_of in self.frames:
            frame = frame_of(batch.masks, patch)
            if frame is not None:
                batch, interval = frame.cut_batch(batch), frame.cut_interval(interval)
                used.append(frame)
        with precision_of(self.precision, batch.images.device):
            prediction = self._predict(batch, interval)
        for frame in reversed(used):
            prediction = frame.paste_prediction(prediction)
        return prediction

    def _predict(self, batch: Batch, interval: Interval | None) -> Prediction:
        tokens = self._in_heads_precision(self.encoder(batch.images, batch.masks, interval))
        depth_maps = self.depth_head(tokens, batch, interval)
        points = self.unproject(depth_maps, tokens, batch)
        tokens = self.recalibration(tokens, points, batch)
        gaussians = self.gaussian_head(tokens, batch, points, depth_maps)
        return Prediction(gaussians, depth_maps.depth, depth_maps.valid, points, depth_maps)

    def _in_heads_precision(self, tokens: Tokens) -> Tokens:
        """Tokens of an encoder whose weights are in half precision, for heads whose weights are not."""
        dtype = next(self.recalibration.parameters()).dtype
        if torch.is_autocast_enabled(tokens.semantic.device.type) or tokens.latent[0].dtype == dtype:
            return tokens
        latent = tuple(layer.to(dtype) for layer in tokens.latent)
        return dataclasses.replace(tokens, latent=latent, semantic=tokens.semantic.to(dtype))

    @classmethod
    def from_config(cls, config: Mapping[str, Any], empty: Collection[str] = ()) -> "GHGS":
        """Build from the nodes ``encoder``, ``depth_head``, ``recalibration``, ``gaussian_head``, and, where
        they are given, ``points``, ``skip`` and ``model.pad``; other keys are ignored.

        Stages in ``empty`` are built without storage (on the meta device), for weights to be assigned to.

        Raises:
            InputError: a stage is missing, or a value is impossible; the message starts with the key.
        """
        for name in STAGES:
            require(name in config, name, "a stage of the model", "nothing")

        def storage(name: str) -> Any:
            return torch.device("meta") if name in empty else nullcontext()

        with storage("encoder"):
            # `weights` says where an imported encoder comes from; it has no part in what is built.
            encoder = build({k: v for k, v in config["encoder"].items() if k != "weights"}, "encoder")
        skip = config.get("skip") or {}
        extra = {name: {} for name in STAGES}
        extra["gaussian_head"] = {key: skip[key] for key in ("pixels", "views") if key in skip}
        if "views" in skip and config["recalibration"].get("tokens") != "all":
            # Otherwise tokens of views without the subject need a depth as well.
            extra["depth_head"] = {"views": skip["views"]}
        stages = {}
        for name in STAGES[1:]:
            with storage(name):
                stages[name] = build(config[name], name, dim_latent=encoder.dim_latent, **extra[name])
        points = config.get("points")
        return cls(
            encoder,
            **stages,
            unprojection=Unprojection(**points) if points else None,
            crop=bool(skip.get("crop", False)),
            pad=(config.get("model") or {}).get("pad", "none"),
        )

    @classmethod
    def from_checkpoint(
        cls, path: str | Path, map_location: Any = "cpu", dtype: torch.dtype | None = None
    ) -> "GHGS":
        """The model of a checkpoint, in evaluation mode, with no YAML at hand.

        The weights are mapped from the file and not read before they are used. ``dtype`` is the encoder's
        (None: as in the file); the heads are float32 or wider.

        Raises:
            FileNotFoundError: there is no such file.
            InputError: the file is no checkpoint of this package, or its weights do not fit its config.
        """
        model = cls.from_config(read_checkpoint(path)["config"], empty=STAGES)
        model.load(path, dtype)
        return model.to(map_location).eval()

    def load(self, path: str | Path, dtype: torch.dtype | None = None) -> None:
        """Take over the weights of a checkpoint, as :meth:`from_checkpoint` does."""
        require_fit(self, model_state(read_checkpoint(path)), path)

        def precision(name: str, stored: torch.dtype) -> torch.dtype:
            if name.startswith("encoder."):
                return dtype or stored
            return torch.promote_types(stored, torch.float32)

        self.load_state_dict(cast(lambda: model_state(read_checkpoint(path)), precision), assign=True)


def check_batch(batch: Batch, patch_size: int) -> None:
    """Refuse a batch that the stages cannot work on, by the name of what is wrong."""
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
