"""Compile all CPU kernels for this processor, as part of `make setup`, so that first commands start fast.

A prediction and its refinement by the shipped weights use all kernels except those of large encoders.
The rasterizer's kernels take longest and are compiled in a second process. Machine code is cached
next to the package, or in NUMBA_CACHE_DIR.
"""

from multiprocessing import get_context

import torch

from ghgs_capture.prediction import predict_batch
from ghgs_lit import Gaussians
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.execution import Predictor
from ghgs_lit.method.rounds import NoRounds
from ghgs_lit.rendering import Renderer

BATCH = ellipsoid_batch(0.15, 4, 56, 1)


def render_once() -> None:
    """Render an image and compute its gradients."""
    parts = (torch.rand(99, 3) - 0.5, torch.rand(99, 4), torch.rand(99, 3) / 9, torch.rand(99))
    gaussians = Gaussians(*(part.requires_grad_() for part in (*parts, torch.rand(99, 3))), (99,))
    Renderer()(gaussians, BATCH.cameras).image.sum().backward()


if __name__ == "__main__":
    drawing = get_context("spawn").Process(target=render_once)
    drawing.start()
    predictor = Predictor.from_checkpoint()
    model = predictor.model
    rounds, model.rounds = model.rounds, NoRounds()  # they render
    with torch.no_grad():
        predictor(BATCH)
    model.rounds = rounds
    drawing.join()
    predict_batch(BATCH, predictor, Renderer(), refine=1)
