"""What validations measure, with a stand-in for the model."""

import dataclasses

import pytest
import torch
from torch.utils.data import DataLoader

from ghgs_lit.metrics.functional import psnr, ssim
from ghgs_lit.metrics.regions import box_of
from ghgs_lit.training import GHGSModule, Optimization
from ghgs_lit.types import DepthMaps
from tests.helpers.losses import losses_of
from tests.helpers.training import (
    CONFIG,
    Standin,
    example_batch,
    flat_renderer,
    loader,
    module,
    trainer,
)


def test_validation_measures_clamped_renders(tmp_path):
    """PSNR and SSIM are of the pictures that are seen, as `ghgs evaluate` measures them."""

    def brighter(gaussians, cameras, by=3.0):
        drawn = flat_renderer(gaussians, cameras)
        pattern = torch.linspace(-1, by, drawn.image.shape[-1])
        return dataclasses.replace(drawn, image=drawn.image + pattern)

    subject, batch = module(brighter), example_batch()
    run = trainer(tmp_path, steps=1)
    (found,) = run.validate(
        subject, DataLoader([batch], batch_size=None, collate_fn=lambda b: b), verbose=False
    )
    image = subject(batch)[1].image.detach().clamp(0, 1).flatten(0, 1)
    target = batch.targets.images.flatten(0, 1)
    assert found["val/ssim"] == pytest.approx(float(ssim(image, target, "reflect").mean()), rel=1e-4)
    assert found["val/psnr"] == pytest.approx(float(psnr(image, target).mean()), rel=1e-4)
    box = box_of(batch.targets.masks.flatten(0, 1))
    assert found["val/psnr_box"] == pytest.approx(float(psnr(image, target, box).mean()), rel=1e-4)


def test_depth_error_is_of_pixels_with_a_prediction(tmp_path):
    """Where the model says that a depth is not valid, it has none that could be wrong."""

    class Half(Standin):
        def forward(self, batch):
            found = super().forward(batch)
            valid = batch.masks & (torch.arange(batch.masks.shape[-1]) < 8)
            depth = torch.where(valid, 2.15, 9.0)
            return dataclasses.replace(found, depth_maps=DepthMaps(depth, valid, torch.ones_like(depth)))

    subject = GHGSModule(Half(), flat_renderer, losses_of({"render_l1": 1.0}), Optimization(lr=0.05), CONFIG)
    (found,) = trainer(tmp_path, steps=1).validate(subject, loader(1), verbose=False)
    assert found["val/depth_error_mm"] == pytest.approx(50, abs=0.01)  # the truth is 2.1 m


def test_rounds_are_measured_as_the_result_is(tmp_path):
    """Renders of the Gaussians before each round are clamped, too,
    and depths are those before it."""

    def brighter(gaussians, cameras):
        drawn = flat_renderer(gaussians, cameras)
        return dataclasses.replace(drawn, image=drawn.image + torch.linspace(-1, 2, drawn.image.shape[-1]))

    class Twice(Standin):
        def forward(self, batch):
            found = super().forward(batch)
            maps = DepthMaps(torch.full_like(found.depth, 2.2), batch.masks, torch.ones_like(found.depth))
            return dataclasses.replace(found, drafts=(found.gaussians,), rounds=(maps, found.depth_maps))

    subject = GHGSModule(Twice(), brighter, losses_of({"render_l1": 1.0}), Optimization(lr=0.05), CONFIG)
    (found,) = trainer(tmp_path, steps=1).validate(subject, loader(1), verbose=False)
    assert found["val/psnr_before_round_1"] == pytest.approx(found["val/psnr"], rel=1e-6)
    assert found["val/depth_error_mm_before_round_1"] == pytest.approx(100, abs=0.01)
