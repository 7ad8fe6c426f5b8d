"""The whole method as one module: photographs in, Gaussians out (paper, section 3)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ghgs_lit.config import build
from ghgs_lit.encoder import VGGTEncoder
from ghgs_lit.errors import InputError, require
from ghgs_lit.geometry.crop import subject_windows
from ghgs_lit.geometry.points import Unprojection
from ghgs_lit.geometry.visual_hull import Interval
from ghgs_lit.heads.depth import DepthHead
from ghgs_lit.heads.gaussian import GaussianHead
from ghgs_lit.recalibration import Recalibration
from ghgs_lit.types import Batch, Prediction

STAGES = ("encoder", "depth_head", "recalibration", "gaussian_head")

#: Version of the checkpoints that :meth:`GHGS.from_checkpoint` reads.
FORMAT_VERSION = 1

#: Where a LightningModule keeps its :class:`GHGS`.
STATE_PREFIX = "model."


class GHGS(nn.Module):
    """Encode, predict depth, unproject, recalibrate, regress Gaussians: ``model(batch) -> Prediction``.

    With ``crop`` the stages see windows around the subject in place of the whole photographs; what
    comes back is that of the whole photographs.
    """

    def __init__(
        self,
        encoder: VGGTEncoder,
        depth_head: DepthHead,
        recalibration: Recalibration,
        gaussian_head: GaussianHead,
        unprojection: Unprojection | None = None,
        crop: bool = False,
    ):
        super().__init__()
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
        self.crop = crop

    def forward(self, batch: Batch) -> Prediction:
        check_batch(batch, self.encoder.patch_size)
        # From the whole frames: a window would hide from the hull what lies beside it.
        interval = self.depth_head.interval(batch)
        if not self.crop:
            return self._predict(batch, interval)
        windows = subject_windows(batch.masks, self.encoder.patch_size)
        if interval is not None:
            interval = (windows.cut(interval[0]), windows.cut(interval[1]))
        return windows.paste_prediction(self._predict(windows.cut_batch(batch), interval))

    def _predict(self, batch: Batch, interval: Interval | None) -> Prediction:
        tokens = self.encoder(batch.images, batch.masks, interval)
        depth_maps = self.depth_head(tokens, batch, interval)
        points = self.unproject(depth_maps, tokens, batch)
        tokens = self.recalibration(tokens, points, batch)
        gaussians = self.gaussian_head(tokens, batch, points, depth_maps)
        return Prediction(gaussians, depth_maps.depth, depth_maps.valid, points, depth_maps)

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> "GHGS":
        """Build from the nodes ``encoder``, ``depth_head``, ``recalibration``, ``gaussian_head``, and, where
        they are given, ``points`` and ``skip``; other keys are ignored.

        Raises:
            InputError: a stage is missing, or a value is impossible; the message starts with the key.
        """
        for name in STAGES:
            require(name in config, name, "a stage of the model", "nothing")
        encoder = build(config["encoder"], "encoder")
        skip = config.get("skip") or {}
        extra = {name: {} for name in STAGES}
        extra["gaussian_head"] = {key: skip[key] for key in ("pixels", "views") if key in skip}
        if "views" in skip and config["recalibration"].get("tokens") != "all":
            # Otherwise tokens of views without the subject need a depth as well.
            extra["depth_head"] = {"views": skip["views"]}
        stages = {
            name: build(config[name], name, dim_latent=encoder.dim_latent, **extra[name])
            for name in STAGES[1:]
        }
        points = config.get("points")
        return cls(
            encoder,
            **stages,
            unprojection=Unprojection(**points) if points else None,
            crop=bool(skip.get("crop", False)),
        )

    @classmethod
    def from_checkpoint(cls, path: str | Path, map_location: Any = "cpu") -> "GHGS":
        """The model of a training checkpoint, in evaluation mode, with no YAML at hand.

        Raises:
            FileNotFoundError: there is no such file.
            InputError: the file is no checkpoint of this project, or its weights do not fit its config.
        """
        checkpoint = read_checkpoint(path, map_location)
        model = cls.from_config(checkpoint["config"])
        state = {
            key.removeprefix(STATE_PREFIX): value
            for key, value in checkpoint["state_dict"].items()
            if key.startswith(STATE_PREFIX)
        }
        load_strictly(model, state, path)
        return model.to(map_location).eval()


def read_checkpoint(path: str | Path, map_location: Any = "cpu") -> dict[str, Any]:
    """Read a checkpoint with ``weights_only=True`` and refuse what is not one of this project."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such checkpoint")
    try:
        checkpoint = torch.load(path, map_location=map_location, weights_only=True)
    except Exception as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise InputError(f"{path}: expected a checkpoint of plain data and tensors; {reason}") from error
    for key, kind in (("state_dict", Mapping), ("config", Mapping), ("format_version", int)):
        found = checkpoint.get(key) if isinstance(checkpoint, Mapping) else None
        if not isinstance(found, kind):
            raise InputError(
                f"{path}: expected a checkpoint with {key!r}; found "
                + (
                    ", ".join(map(repr, checkpoint))
                    if isinstance(checkpoint, Mapping)
                    else repr(type(checkpoint))
                )
            )
    if checkpoint["format_version"] > FORMAT_VERSION:
        raise InputError(
            f"{path}: expected format_version {FORMAT_VERSION} or less; found "
            f"{checkpoint['format_version']}, of a newer version of this package"
        )
    return checkpoint


def load_strictly(module: nn.Module, state: Mapping[str, torch.Tensor], source: str | Path) -> None:
    """Load all of ``state`` into ``module``; a mismatch names the source, the key and both shapes."""
    own = module.state_dict()
    for key in own:
        require(key in state, f"{source}: {key}", f"a tensor of shape {tuple(own[key].shape)}", "nothing")
    for key, value in state.items():
        require(key in own, f"{source}: {key}", "no such key in the configured model", tuple(value.shape))
        shape = tuple(own[key].shape)
        require(
            tuple(value.shape) == shape,
            f"{source}: {key}",
            f"shape {shape} of the configured model",
            tuple(value.shape),
        )
    module.load_state_dict(state)


def check_batch(batch: Batch, patch_size: int) -> None:
    """Refuse a batch that the stages cannot work on, by the name of what is wrong."""
    require(batch.images.dim() == 5, "batch.images", "[B, V, 3, H, W]", tuple(batch.images.shape))
    b, v, _, height, width = batch.images.shape
    require(v >= 2, "batch.images", "2 views or more", v)
    divisible = height % patch_size == width % patch_size == 0
    require(divisible, "batch.images", f"sides divisible by the patch size {patch_size}", (height, width))
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
