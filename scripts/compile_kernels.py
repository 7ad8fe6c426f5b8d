"""Compiles what runs on the CPU for this processor: `make setup` calls it, so that no first command waits.

A prediction and its refinement by the weights that come with the package use all kernels but those of large
encoders. The rasterizer's take longest: another process compiles them. The machine code is kept beside the
package, or in NUMBA_CACHE_DIR.
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


def draw() -> None:
    """An image, and its gradients."""
    parts = (torch.rand(99, 3) - 0.5, torch.rand(99, 4), torch.rand(99, 3) / 9, torch.rand(99))
    gaussians = Gaussians(*(part.requires_grad_() for part in (*parts, torch.rand(99, 3))), (99,))
    Renderer()(gaussians, BATCH.cameras).image.sum().backward()


if __name__ == "__main__":
    drawing = get_context("spawn").Process(target=draw)
    drawing.start()
    predictor = Predictor.from_checkpoint()
    model = predictor.model
    rounds, model.rounds = model.rounds, NoRounds()  # they draw
    with torch.no_grad():
        predictor(BATCH)
    model.rounds = rounds
    drawing.join()
    predict_batch(BATCH, predictor, Renderer(), refine=1)
