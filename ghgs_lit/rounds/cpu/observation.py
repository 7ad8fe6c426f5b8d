"""What views show of Gaussians, distributed over threads."""

from functools import partial
from itertools import accumulate, pairwise

from jaxtyping import Float
from torch import Tensor

from ghgs_lit.kernels import pool
from ghgs_lit.kernels.parts import even_parts
from ghgs_lit.types import Cameras, Gaussians, Rendering

#: Gaussians of one task.
_TASK = 1024


def compare(
    gaussians: Gaussians,
    cameras: Cameras,
    photo: Float[Tensor, "B V 3 H W"],
    mask: Float[Tensor, "B V H W"],
    rendering: Rendering,
    near: float,
    out: Float[Tensor, "N V 11"],
) -> None:
    """Write the values of :func:`ghgs_lit.rounds.observation.observe`. ``rendering``: of the Gaussians, by
    ``cameras``. ``near``: metres behind the rendered surface at which a Gaussian counts as hidden."""
    from ghgs_lit.rounds.cpu.kernel import observe  # here: it loads a compiler

    inputs = (
        *(gaussians.means, gaussians.colors, gaussians.image, cameras.intrinsics, cameras.extrinsics),
        *(photo, mask, rendering.image, rendering.alpha, rendering.depth),
    )
    arrays = [x.contiguous().numpy() for x in inputs]
    pool.run(
        [
            partial(observe(), *arrays, near, out.numpy(), first + part.start, first + part.stop)
            for first, last in pairwise((0, *accumulate(gaussians.splits)))
            for part in even_parts(last - first, _TASK)
            if last > first
        ],
        len(gaussians),
    )
