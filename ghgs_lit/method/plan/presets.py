"""Presets that leave out patches and pixels, and ``skip=auto``:
the cheapest preset within a budget."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from pydantic import model_validator
from torch import Tensor

from ghgs_lit.config.options import Amount, Count, Options, Patches, Text
from ghgs_lit.types import Decision, DecodedPixels


class KeptTokens(NamedTuple):
    """The ``tokens`` and ``margin`` of an encoder; the margin is 0 with all tokens."""

    tokens: str
    margin: int = 0

    @classmethod
    def of_budget(cls, budget: str | int) -> "KeptTokens":
        """The view for one choice of ``token_budgets``.

        Args:
            budget: number of patches around the subject that stay;
                or a value of ``tokens``, such as ``all``.
        """
        return cls("subject", budget) if isinstance(budget, int) else cls(budget)


@contextmanager
def seeing(encoder: Any, view: KeptTokens) -> Iterator[None]:
    """Let an encoder work on other patches while the context lasts.

    Args:
        encoder: a :class:`ghgs_lit.method.encoder.VGGTEncoder`.
        view: its ``tokens`` and ``margin``.
    """
    before = (encoder.tokens, encoder.margin)
    encoder.tokens, encoder.margin = view
    try:
        yield
    finally:
        encoder.tokens, encoder.margin = before


#: PSNR in dB that ``skip=exact`` may lose by rounding.
EXACT_LOSS = 0.001


class Preset(Options):
    """What is left out of the work, and what that may cost."""

    name: Text = "exact"
    """Name of the preset, for reports."""
    tokens: Literal["all", "window", "subject"] = "all"
    """Patches that the encoder works on: all, those of the smallest rectangle around the subject
    (window), or the subject's."""
    margin: Patches = 1
    """Patches around the window or the subject that stay."""
    pixels: DecodedPixels = "subject"
    """Pixels that the dense heads decode: whole views, or windows around the subject. The depth
    head decodes all where recalibration.tokens=all: all tokens need a depth."""
    every: Count = 1
    """Of so many instants of a sequence the first is predicted anew, the others move its Gaussians;
    1: each is predicted by itself."""
    budget_db: float | None = EXACT_LOSS
    """PSNR that may be lost against skip=none, in dB (`ghgs benchmark` checks it);
    null: no promise."""
    max_rel_diff: Amount | None = 1e-5
    """Largest difference of 99 of 100 values of an attribute or a render from skip=none, as a share
    of the largest value, times what the model amplifies one rounding of the photographs by;
    `ghgs benchmark` checks it. null: nothing is promised."""

    @property
    def view(self) -> KeptTokens:
        """Which patches the encoder works on."""
        return KeptTokens(self.tokens, 0 if self.tokens == "all" else self.margin)

    @property
    def is_exact(self) -> bool:
        """Whether the preset promises the values of ``skip=none``, for any weights."""
        return self.max_rel_diff is not None


class Choices(Options):
    """PSNR that presets may lose against ``skip=none``, in dB; null: not that one."""

    balanced: Amount | None = None
    """The encoder works on a window around the subject."""
    fast: Amount | None = None
    """The encoder works on the subject and ``skip.margin`` patches around it."""


class SkipOptions(Preset):
    """A preset, or several to choose from."""

    group = "skip"
    choices: Choices = Choices()
    """With skip=auto: the presets to choose from beside exact; none: this is a preset itself."""

    @model_validator(mode="after")
    def _check(self) -> "SkipOptions":
        """Refuse a key that would be ignored, and a budget without a preset."""
        if self.presets:
            self.require(self.tokens == "all", "tokens", "all with skip=auto, which chooses it")
            enough = self.budget_db is not None and self.budget_db >= EXACT_LOSS
            self.require(enough, "budget_db", f"{EXACT_LOSS:g} or more with skip=auto")
        return self

    @property
    def presets(self) -> dict[str, Preset]:
        """The presets to choose from by name, equal to the files in conf/skip;
        empty without ``choices``."""
        exact = Preset(pixels=self.pixels, budget_db=EXACT_LOSS)
        seen = {"balanced": ("window", 0), "fast": ("subject", self.margin)}
        others = {}
        for name, loss in self.choices:
            if loss is not None:
                seen_by = dict(zip(("tokens", "margin"), seen[name], strict=True))
                others[name] = exact.replace(name=name, **seen_by, budget_db=loss, max_rel_diff=None)
        return {"exact": exact, **others} if others else {}

    def build(self) -> "AutoSkip | None":
        """The chooser among the presets; None without presets."""
        if not self.presets:
            return None
        ordered = dict(sorted(self.presets.items(), key=lambda item: item[1].budget_db))
        within = {name: preset for name, preset in ordered.items() if preset.budget_db <= self.budget_db}
        beyond = {n: f"may lose {p.budget_db:g} dB" for n, p in ordered.items() if n not in within}
        return AutoSkip(within, self.budget_db, beyond)


@dataclass(frozen=True)
class AutoSkip:
    """Gives each subject the preset of the budget in which the encoder has the fewest FLOPs.

    Only the encoder counts: the heads compute windows around the subject in every preset. The
    choice does not depend on the machine; half precision is chosen separately (``precision=auto``).

    Attributes:
        presets: those within the budget, the most accurate first.
        budget_db: PSNR in dB that may be lost against ``skip=none``.
        left_out: the other presets, with the reason.
    """

    presets: Mapping[str, Preset]
    budget_db: float
    left_out: Mapping[str, str]

    def trained_by(self, config: Mapping[str, Any]) -> "AutoSkip":
        """Only the presets that occurred in a training: the loss of others is unknown.

        Args:
            config: of the training; its ``skip`` and ``token_budgets`` are read.
        """
        shown = {SkipOptions.read(config.get("skip") or {}, "skip").view}
        shown |= {KeptTokens.of_budget(budget) for budget in config.get("token_budgets") or []}
        known = {n: p for n, p in self.presets.items() if p.is_exact or p.view in shown}
        unknown = {name: "not shown in training" for name in self.presets if name not in known}
        return replace(self, presets=known, left_out={**unknown, **self.left_out})

    def choices(self, encoder: Any, masks: Bool[Tensor, "B V H W"]) -> list[Bool[Tensor, "B V h w"]]:
        """The patches that each preset keeps.

        Args:
            encoder: a :class:`ghgs_lit.method.encoder.VGGTEncoder`.
            masks: the subject's pixels; sides are divisible by the patch size.
        """
        kept = []
        for preset in self.presets.values():
            with seeing(encoder, preset.view):
                kept.append(encoder.keeps(masks))
        return kept

    def choose(
        self, encoder: Any, counts: Sequence[Int[Tensor, "B V"]]
    ) -> tuple[tuple[Decision, ...], list[int]]:
        """The preset of each element, by its masks alone; among equals the most accurate.

        Args:
            encoder: a :class:`ghgs_lit.method.encoder.VGGTEncoder`.
            counts: numbers of patches that each preset keeps, on the CPU.

        Returns:
            The decision for each element, and the number of its preset.
        """
        table = torch.stack([encoder_products(encoder, kept) for kept in counts], dim=-1)
        best = [min(range(len(counts)), key=row.__getitem__) for row in table.tolist()]
        names = list(self.presets)
        shares = (table / table[:, :1]).tolist()
        return tuple(Decision(names[k], share[k]) for k, share in zip(best, shares, strict=True)), best

    def report(self, decisions: Sequence[Decision]) -> str:
        """One line that says which presets the subjects got, and why.

        Args:
            decisions: one for each subject.
        """
        shares: dict[str, list[float]] = {name: [] for name in self.presets}
        for decision in decisions:
            shares[decision.preset].append(decision.products)
        parts = []
        for name, products in sorted(shares.items(), key=lambda item: -len(item[1])):
            if products:
                times = f" for {len(products)} of {len(decisions)}" if len(decisions) > 1 else ""
                parts.append(f"{name}{times} ({fmean(products):.0%})")
        why = f"the fewest products in the encoder within skip.budget_db={self.budget_db:g}"
        unsure = [n for n, products in shares.items() if products and not self.presets[n].is_exact]
        if unsure:
            why += f"; what {' and '.join(unsure)} may lose is configured, `ghgs benchmark` measures it"
        left_out = "".join(f"; not {name}: {reason}" for name, reason in self.left_out.items())
        return f"skip=auto: {', '.join(parts)}, {why} (100% is {next(iter(self.presets))}){left_out}"


def encoder_products(encoder: Any, kept: Int[Tensor, "B V"]) -> Float[Tensor, " B"]:
    """FLOPs of a frame block and a global block for each element.

    The linear layers of a block take 24 n C^2 for n tokens of width C (6 for queries, keys and
    values, 2 for the projection of the attention's output, 16 for the MLP of four times the
    width), attention among m tokens 4 m^2 C: within a view in the frame block, among all views in
    the global block.

    Args:
        encoder: a :class:`ghgs_lit.method.encoder.VGGTEncoder`.
        kept: numbers of patches that are kept.
    """
    tokens = (kept + encoder.aggregator.special).double()
    width = encoder.dim_latent // 2
    both = tokens.sum(1)
    return 48 * width**2 * both + 4 * width * (tokens.square().sum(1) + both.square())
