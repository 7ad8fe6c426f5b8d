"""The kernel distributed over threads; the result has the same bits with any number of them."""

from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.kernels import pool
from ghgs_lit.kernels.parts import even_parts

#: Gaussians of one task, and how many of the pool's pieces of work one of them is.
_TASK, _WORK = 512, 8


def remembered(
    view: nn.Sequential,
    update: nn.Sequential,
    memory: nn.Linear,
    each: Float[Tensor, "N V c"],
    known: Float[Tensor, "N k"],
    before: Float[Tensor, "N h"],
) -> Float[Tensor, "N h"]:
    """``tanh(before + memory(update(seen, known, before)))``; see :meth:`ghgs_lit.rounds.Rounds._remembered`.

    Args:
        view, update: of two layers each; ``seen`` is ``view`` of the own view, and of the others the mean and
            the largest.
        memory: the last layer.
        each: what each view shows, the own one first.
        known: what is known beside it.
        before: what was remembered.
    """
    from ghgs_lit.kernels.layers import packed  # here, like the kernel: it loads a compiler
    from ghgs_lit.rounds.cpu.kernel import remember

    layers = np.concatenate([packed(x) for x in (*view, *update, memory) if isinstance(x, nn.Linear)])
    after = torch.empty_like(before)
    rows = [x.contiguous().numpy() for x in (each, known, before)]
    pool.run(
        [
            partial(remember(), *rows, layers, after.numpy(), part.start, part.stop)
            for part in even_parts(len(before), _TASK)
        ],
        _WORK * len(before),
    )
    return after


def answered(
    hear: nn.Linear, change: nn.Linear, heard: Float[Tensor, "N e"], before: Float[Tensor, "N h"]
) -> tuple[Float[Tensor, "N h"], Float[Tensor, "N c"]]:
    """``after = before + hear(relu(heard))``, and ``change(after)``."""
    from ghgs_lit.kernels.layers import packed
    from ghgs_lit.rounds.cpu.kernel import answer

    layers = np.concatenate([packed(hear), packed(change)])
    after, changed = torch.empty_like(before), before.new_empty(len(before), len(change.bias))
    rows = [x.contiguous().numpy() for x in (heard, before)]
    pool.run(
        [
            partial(answer(), *rows, layers, after.numpy(), changed.numpy(), part.start, part.stop)
            for part in even_parts(len(before), _TASK)
        ],
        len(before),
    )
    return after, changed
