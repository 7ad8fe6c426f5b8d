"""Random budgets of tokens: weights that have seen every budget serve every preset of ``conf/skip``."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import numpy as np

from ghgs_lit.errors import choice, require
from ghgs_lit.model import GHGS
from ghgs_lit.skipping import View, seeing

KEY = "token_budgets"
#: Budgets with a name; all others are a margin.
NAMED = ("all", "window")


@dataclass(frozen=True)
class TokenBudgets:
    """Draws for each training step how much of the background the encoder sees.

    Args:
        choices: ``all``: all patches (``skip=none``, ``exact``); ``window``: those of the smallest rectangle
            that holds the subject (``balanced``); a number: the subject's patches and those at most this many
            patches away (``fast``). What is listed twice is drawn twice as often.

    Raises:
        InputError: there is no choice, or one of another kind.
    """

    choices: Sequence[str | int]

    def __post_init__(self) -> None:
        require(len(self.choices) > 0, KEY, "null or a list with a budget", list(self.choices))
        for budget in self.choices:
            if isinstance(budget, int):
                require(budget >= 0, KEY, "margins of 0 or more patches", budget)
            else:
                choice(KEY, budget, (*NAMED, "a number of patches"))

    def draw(self, numbers: Sequence[int]) -> str | int:
        """The budget of the step that ``numbers`` stand for; equal numbers give the same one."""
        # A key of its own: the same numbers seed the other draws of the step.
        generator = np.random.default_rng(np.random.SeedSequence(numbers, spawn_key=(1,)))
        return self.choices[int(generator.integers(len(self.choices)))]


def token_budget(model: GHGS, budget: str | int | None) -> AbstractContextManager[None]:
    """``model`` with one of the choices of :class:`TokenBudgets` while the context lasts; None: as it is."""
    return nullcontext() if budget is None else seeing(model.encoder, View.of_budget(budget))
