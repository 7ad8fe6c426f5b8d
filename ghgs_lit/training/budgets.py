"""Random budgets of tokens: weights that have seen every budget serve every preset of ``conf/skip``."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

import numpy as np

from ghgs_lit.model import GHGS
from ghgs_lit.skipping import View, seeing


def drawn_budget(budgets: Sequence[str | int], numbers: Sequence[int]) -> str | int:
    """How much of the background the encoder sees in a training step.

    Args:
        budgets: ``all``: all patches (``skip=none``, ``exact``); ``window``: those of the smallest rectangle
            that holds the subject (``balanced``); a number: the subject's patches and those at most this many
            patches away (``fast``). What is listed twice is drawn twice as often.
        numbers: that the step stands for; equal numbers give the same budget.
    """
    # A key of its own: the same numbers seed the other draws of the step.
    generator = np.random.default_rng(np.random.SeedSequence(numbers, spawn_key=(1,)))
    return budgets[int(generator.integers(len(budgets)))]


def token_budget(model: GHGS, budget: str | int | None) -> AbstractContextManager[None]:
    """``model`` with one of the budgets of :func:`drawn_budget` while the context lasts; None: as it is."""
    return nullcontext() if budget is None else seeing(model.encoder, View.of_budget(budget))
