"""A model and a renderer that train in microseconds, and batches for them."""

import dataclasses
import math

import lightning.pytorch as L
import torch
from torch import nn
from torch.utils.data import DataLoader, Dataset

from ghgs_lit.data.batches import StepSampler
from ghgs_lit.data.datamodule import count_trained_batches
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.rendering import render
from ghgs_lit.training import GHGSModule
from ghgs_lit.training.base import BudgetedModule
from ghgs_lit.training.checkpoints import Checkpoints
from ghgs_lit.training.optimization import Optimization
from ghgs_lit.types import (
    Batch,
    Cameras,
    DepthMaps,
    Gaussians,
    Points,
    Prediction,
    Rendering,
    Targets,
)
from tests.helpers.cameras import camera_ring
from tests.helpers.losses import losses_of


def ring(count: int, size: int, radius: float = 2.0, start: float = 0.0) -> Cameras:
    """Cameras [count] around the origin; ``start`` is the first one's angle in radians."""
    return camera_ring(count, size, size, radius=radius, start=math.degrees(start))[0]


def batched(cameras: Cameras, count: int) -> Cameras:
    """``count`` copies of the same cameras [count, V]."""
    return cameras[None][torch.zeros(count, dtype=torch.long)]


def example_batch(
    subjects: int = 2, views: int = 3, targets: int = 1, size: int = 16, seed: int = 0
) -> Batch:
    g = torch.Generator().manual_seed(seed)
    masks = torch.zeros(subjects, views, size, size, dtype=torch.bool)
    masks[..., 4:12, 5:11] = True
    images = torch.rand(subjects, views, 3, size, size, generator=g) * masks[:, :, None]
    return Batch(
        images=images,
        masks=masks,
        cameras=batched(ring(views, size), subjects),
        targets=Targets(
            images=torch.rand(subjects, targets, 3, size, size, generator=g) * 0.5,
            masks=masks[:, :1].expand(-1, targets, -1, -1),
            cameras=batched(ring(targets, size, start=0.2), subjects),
            names=tuple(tuple(f"00{k}/3" for k in range(targets)) for _ in range(subjects)),
            protocols=("midway",) * targets,
        ),
        body_vertices=[torch.rand(20, 3, generator=g) * 0.2 for _ in range(subjects)],
        depths=torch.full((subjects, views, size, size), 2.1) * masks,
        subjects=tuple(f"p{i}" for i in range(subjects)),
        views=tuple(tuple(f"00{k}/0" for k in range(views)) for _ in range(subjects)),
    )


class Standin(nn.Module):
    """A model with one depth for all pixels and one offset of the colours."""

    def __init__(self):
        super().__init__()
        self.depth = nn.Parameter(torch.tensor(2.5))
        self.shift = nn.Parameter(torch.zeros(3))

    def forward(self, batch: Batch) -> Prediction:
        masks = batch.masks
        depth = self.depth.expand(masks.shape)
        pixels = unproject_maps(depth, batch.cameras)
        n = int(masks.sum())
        gaussians = Gaussians(
            means=pixels[masks],
            quaternions=torch.tensor([1.0, 0, 0, 0]).expand(n, 4),
            scales=torch.full((n, 3), 0.01),
            opacities=torch.full((n,), 0.9),
            colors=batch.images.movedim(2, -1)[masks] + self.shift,
            splits=tuple(masks.flatten(1).sum(1).tolist()),
        )
        nothing = torch.zeros(0, 3), torch.zeros(0, dtype=torch.bool), torch.zeros(0, dtype=torch.int64)
        maps = DepthMaps(depth, masks, torch.ones_like(depth))
        return Prediction(gaussians, depth, masks, Points(pixels, masks, *nothing), maps)


def held(model: nn.Module, optimization: Optimization | None = None) -> BudgetedModule:
    """A LightningModule with only the model."""
    return BudgetedModule(model, optimization or Optimization(lr=0.05), None)


def flat_renderer(gaussians: Gaussians, cameras: Cameras) -> Rendering:
    """Render the mean colour of the Gaussians in every pixel, which is differentiable."""
    b, t = cameras.shape
    colors = torch.stack([gaussians[i].colors.mean(0) for i in range(b)])
    image = colors[:, None, :, None, None].expand(b, t, 3, cameras.height, cameras.width)
    ones = torch.ones(b, t, 1, cameras.height, cameras.width)
    return Rendering(image, ones, ones)


class _Steps(Dataset):
    def __init__(self, length: int):
        self.length = length

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, step: int) -> Batch:
        return example_batch(seed=step)


class StepData(L.LightningDataModule):
    """Training batches that are functions of the step, in epochs of ``length``; two for validation."""

    def __init__(self, length: int = 5):
        super().__init__()
        self.length = length

    def train_dataloader(self) -> DataLoader:
        steps = _Steps(self.length)
        sampler = StepSampler(steps, lambda: count_trained_batches(self.trainer, self.length))
        return DataLoader(steps, batch_size=None, collate_fn=lambda b: b, sampler=sampler)

    def val_dataloader(self) -> DataLoader:
        batches = [example_batch(seed=1000 + i) for i in range(2)]
        return DataLoader(batches, batch_size=None, collate_fn=lambda b: b)


CONFIG = {"encoder": {"width": 3, "layers": [0, 1]}, "seed": 1, "resume": None}


def module(renderer=flat_renderer, lr=0.05, **weights) -> GHGSModule:
    """A training of the stand-in; ``weights``: of the losses."""
    weights = weights or {"render_l1": 0.8, "render_ssim": 0.2, "chamfer": 1.0, "depth": 0.5}
    return GHGSModule(
        Standin(), renderer, losses_of(weights), Optimization(lr=lr, warmup=0.1, end_factor=0.0), CONFIG
    )


def trainer(folder, steps=12, callbacks=(), **options) -> L.Trainer:
    """A trainer on the CPU without logs; ``options`` replace its defaults."""
    defaults = {
        "logger": False,
        "enable_checkpointing": any(isinstance(c, Checkpoints) for c in callbacks),
        "enable_progress_bar": False,
        "val_check_interval": 6,
    }
    return L.Trainer(
        accelerator="cpu",
        max_steps=steps,
        max_epochs=-1,
        default_root_dir=folder,
        callbacks=list(callbacks),
        enable_model_summary=False,
        num_sanity_val_steps=0,
        check_val_every_n_epoch=None,
        **{**defaults, **options},
    )


def loader(count=3) -> DataLoader:
    """The same ``count`` different batches in each epoch."""
    return DataLoader([example_batch(seed=s) for s in range(count)], batch_size=None, collate_fn=lambda b: b)


def photographed(gaussians: Gaussians, cameras: Cameras) -> tuple[Batch, Prediction]:
    """Renders of Gaussians as input views, and a prediction with these Gaussians."""
    rendering = render(gaussians, cameras)
    batch = Batch(rendering.image.clamp(0, 1), rendering.alpha[:, :, 0] > 0.5, cameras)
    return batch, dataclasses.replace(Standin()(batch), gaussians=gaussians)
