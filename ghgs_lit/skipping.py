"""What the stages see of a subject, and ``skip=auto``: the cheapest preset within a budget, by the masks."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.types import Decision


class View(NamedTuple):
    """What an encoder sees: its ``tokens`` and ``margin``, which is 0 with all tokens."""

    tokens: str
    margin: int = 0

    @classmethod
    def of_budget(cls, budget: str | int) -> "View":
        """What a choice of ``token_budgets`` lets the encoder see."""
        return cls("subject", budget) if isinstance(budget, int) else cls(budget)

    @classmethod
    def of_preset(cls, skip: Mapping[str, Any]) -> "View":
        """What a node ``skip`` lets the encoder see."""
        return cls(skip["tokens"], 0 if skip["tokens"] == "all" else skip["margin"])


@contextmanager
def seeing(encoder: Any, view: View) -> Iterator[None]:
    """A :class:`ghgs_lit.encoder.VGGTEncoder` that sees ``view`` while the context lasts."""
    before = (encoder.tokens, encoder.margin)
    encoder.tokens, encoder.margin = view
    try:
        yield
    finally:
        encoder.tokens, encoder.margin = before


@dataclass(frozen=True)
class Preset:
    """A preset of ``conf/skip``.

    Args:
        view: what the encoder sees.
        budget_db: PSNR that it may lose against ``skip=none``.
        is_exact: whether it promises the values of ``skip=none``, so that its loss is known for any weights.
    """

    view: View
    budget_db: float
    is_exact: bool


@dataclass(frozen=True)
class AutoSkip:
    """Gives each subject the preset in which the encoder has the fewest products, among those in the budget.

    The encoder's products decide: the heads compute windows around the subject in every preset. Presets lose
    what their YAML says (``ghgs benchmark`` checks it). The machine has no say: half precision is a choice of
    its own for every preset (``precision=auto``).

    Args:
        presets: by name, those in the budget, the most accurate first.
        budget_db: PSNR that may be lost against ``skip=none``.
        left_out: why the other presets are none of them, by name.
    """

    presets: Mapping[str, Preset]
    budget_db: float
    left_out: Mapping[str, str]

    def trained_by(self, config: Mapping[str, Any]) -> "AutoSkip":
        """Without the presets that the training of ``config`` never showed: nobody knows what they lose."""
        shown = {View.of_preset(config["skip"])} if config.get("skip") else {View("all")}
        shown |= {View.of_budget(budget) for budget in config.get("token_budgets") or []}
        known = {n: p for n, p in self.presets.items() if p.is_exact or p.view in shown}
        unknown = {name: "not shown in training" for name in self.presets if name not in known}
        return replace(self, presets=known, left_out={**unknown, **self.left_out})

    def decide(
        self, encoder: Any, masks: Bool[Tensor, "B V H W"]
    ) -> tuple[tuple[Decision, ...], Bool[Tensor, "B V h w"]]:
        """The preset of each element, which depends on its own masks alone; of equals the most accurate.

        Args:
            encoder: the :class:`ghgs_lit.encoder.VGGTEncoder` that will see them.
            masks: sides are divisible by the patch size.

        Returns:
            The decisions, and the patches that they keep, on the CPU.
        """
        choices = []
        for preset in self.presets.values():
            with seeing(encoder, preset.view):
                choices.append(encoder.keeps(masks).cpu())
        table = torch.stack([encoder_products(encoder, kept) for kept in choices], dim=-1)
        best = [min(range(len(choices)), key=row.__getitem__) for row in table.tolist()]
        kept = torch.stack([choices[k][element] for element, k in enumerate(best)])
        names, shares = list(self.presets), (table / table[:, :1]).tolist()
        return tuple(Decision(names[k], share[k]) for k, share in zip(best, shares, strict=True)), kept

    def report(self, decisions: Sequence[Decision]) -> str:
        """One line: which presets the subjects got, and why."""
        shares: dict[str, list[float]] = {name: [] for name in self.presets}
        for decision in decisions:
            shares[decision.preset].append(decision.products)
        parts = []
        for name, found in sorted(shares.items(), key=lambda item: -len(item[1])):
            if found:
                times = f" for {len(found)} of {len(decisions)}" if len(decisions) > 1 else ""
                parts.append(f"{name}{times} ({fmean(found):.0%})")
        why = f"the fewest products in the encoder within skip.budget_db={self.budget_db:g}"
        left_out = "".join(f"; not {name}: {reason}" for name, reason in self.left_out.items())
        return f"skip=auto: {', '.join(parts)}, {why} (100% is {next(iter(self.presets))}){left_out}"


def auto_skip(skip: Mapping[str, Any]) -> AutoSkip | None:
    """What the node ``skip`` says; None where it is a preset itself.

    Raises:
        InputError: no preset is in the budget, or a key would be ignored.
    """
    if not skip.get("choices"):
        return None
    expected = "all with skip=auto, which chooses it"
    require(skip["tokens"] == "all", "skip.tokens", expected, skip["tokens"])
    presets = {}
    for name, node in skip["choices"].items():
        place = f"skip.choices.{name}"
        for key in ("pixels", "margin") if node["tokens"] == "subject" else ("pixels",):
            require(node[key] == skip[key], f"{place}.{key}", f"{skip[key]}, as skip.{key}", node[key])
        require(node["budget_db"] is not None, f"{place}.budget_db", "a number", None)
        is_exact = node["max_rel_diff"] is not None
        presets[name] = Preset(View.of_preset(node), node["budget_db"], is_exact)
    ordered = dict(sorted(presets.items(), key=lambda item: item[1].budget_db))
    limit, least = skip["budget_db"], next(iter(ordered.values())).budget_db
    require(
        limit is not None and limit >= least, "skip.budget_db", f"{least:g} or more with skip=auto", limit
    )
    within = {name: preset for name, preset in ordered.items() if preset.budget_db <= limit}
    beyond = {n: f"may lose {p.budget_db:g} dB" for n, p in ordered.items() if n not in within}
    return AutoSkip(within, limit, beyond)


def encoder_products(encoder: Any, kept: Bool[Tensor, "B V h w"]) -> Float[Tensor, " B"]:
    """FLOPs of a pair of the encoder's blocks for each element, with the patches that are kept.

    Products with weights take 24 n C^2 in a block (6 for queries, keys and values, 2 for what leaves the
    attention, 16 for the MLP of four times the width), attention among m tokens 4 m^2 C: within a view in
    the frame block, among all views in the global block.

    Args:
        encoder: a :class:`ghgs_lit.encoder.VGGTEncoder`.
        kept: patches that take part.
    """
    tokens = (kept.flatten(2).sum(-1) + encoder.aggregator.special).double()
    width, both = encoder.dim_latent // 2, tokens.sum(1)
    return 48 * width**2 * both + 4 * width * (tokens.square().sum(1) + both.square())
