"""Rounds for CPUs: all steps for a few Gaussians at a time."""

from functools import partial
from itertools import accumulate, pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.kernels import pool
from ghgs_lit.kernels.pool import even_parts
from ghgs_lit.types import Cameras, Gaussians, Rendering

#: Gaussians in one task, and the work of one as the pool counts it.
_TASK = 512
_WORK = 8
#: Gaussians in one task of the gradients: each task has its own sums.
_LEARNED = 2048


def remembered(
    view: nn.Sequential,
    update: nn.Sequential,
    memory: nn.Linear,
    each: Float[Tensor, "N V c"],
    known: Float[Tensor, "N k"],
    before: Float[Tensor, "N h"],
) -> Float[Tensor, "N h"]:
    """``tanh(before + memory(update(seen, known, before)))``,
    differentiable in ``before`` and the layers.

    As :meth:`ghgs_lit.method.rounds.Rounds._remembered`; what is seen are results of ``view`` for the
    Gaussian's own view, and their mean and maximum over the other views.

    Args:
        view: two layers, for each view.
        update: two layers.
        memory: the last layer.
        each: observations of each view, the own one first; float32 on a CPU, as are the next two.
        known: what is known of each Gaussian beside them.
        before: memory of the rounds before.
    """
    from ghgs_lit.kernels.layers import parameters  # here, like the kernels: it loads a compiler

    return _Remember.apply(each, known, before, *parameters((*view, *update, memory)))


class _Remember(torch.autograd.Function):
    @staticmethod
    def forward(ctx, each, known, before, *numbers):
        from ghgs_lit.kernels.layers import packed
        from ghgs_lit.method.rounds.cpu.kernel import remember

        layers = packed(numbers)
        after = torch.empty_like(before)
        rows = [x.detach().contiguous() for x in (each, known, before)]
        given = (*(x.numpy() for x in rows), layers, after.numpy())
        pool.run_rows(remember(), given, [(0, len(before))], _TASK, _WORK * len(before))
        ctx.save_for_backward(*rows, after, *numbers)
        return after

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, slope):
        from ghgs_lit.kernels.layers import Sums, packed
        from ghgs_lit.method.rounds.cpu.gradients import remember_back

        *rows, numbers = *ctx.saved_tensors[:4], ctx.saved_tensors[4:]
        parts = even_parts(len(slope), _LEARNED)
        sums = Sums(numbers, len(parts))
        d_before = torch.empty_like(slope)
        arrays = [x.numpy() for x in (*rows, slope.contiguous())]
        layers = packed(numbers), packed(numbers, transposed=True), sums.places
        tasks = [
            partial(remember_back(), *arrays, *layers, own, d_before.numpy(), part.start, part.stop)
            for own, part in zip(sums.of_task, parts, strict=True)
        ]
        pool.run(tasks, 4 * _WORK * len(slope))
        return None, None, d_before, *sums.gradients()


#: Gaussians in one task of :func:`compare`.
_OBSERVED = 1024


def compare(
    gaussians: Gaussians,
    cameras: Cameras,
    photo: Float[Tensor, "B V 3 H W"],
    mask: Float[Tensor, "B V H W"],
    rendering: Rendering,
    near: float,
    out: Float[Tensor, "N V 11"],
) -> None:
    """Write the values of :func:`ghgs_lit.method.rounds.observation.observe`.

    Args:
        gaussians: on a CPU, with the pixels that they belong to.
        cameras: [B, V], of the photographs.
        photo: photographs in [0, 1].
        mask: share of each pixel that shows the subject.
        rendering: of the Gaussians from ``cameras``.
        near: scale in metres of the distance behind the rendered surface.
        out: written.
    """
    from ghgs_lit.method.rounds.cpu.kernel import observe  # here: it loads a compiler

    inputs = (
        *(gaussians.means, gaussians.colors, gaussians.image, cameras.intrinsics, cameras.extrinsics),
        *(photo, mask, rendering.image, rendering.alpha, rendering.depth),
    )
    arrays = [x.contiguous().numpy() for x in inputs]
    ranges = pairwise((0, *accumulate(gaussians.splits)))
    pool.run_rows(observe(), (*arrays, near, out.numpy()), ranges, _OBSERVED, len(gaussians))
