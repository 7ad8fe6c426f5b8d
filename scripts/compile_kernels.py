"""Compiles what runs on the CPU for this processor: `make setup` calls it, so that no first command waits.

A prediction and its refinement by the weights that come with the package use all kernels but those of large
encoders. The machine code is kept beside the package, or in NUMBA_CACHE_DIR.
"""

from ghgs_lit import GHGS
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.prediction.capture.predict import predict_batch
from ghgs_lit.rendering import Renderer

predict_batch(ellipsoid_batch(0.15, 4, 56, 1), GHGS.from_checkpoint(), Renderer(), refine=1)
