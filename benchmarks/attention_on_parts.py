"""How much of the recalibration's attention falls on other parts of the body; what features change of it.

    python benchmarks/attention_on_parts.py shipped [checkpoint ...]

Twelve built-in people, four views. `untrained` is the recalibration of the first checkpoint's model with new
weights. Features are the model's own, or `true`: those of a branch that knows the shares of the parts in each
patch. Logits of standard deviation 3 are the model's, scaled.
"""

import dataclasses
import sys
from collections.abc import Iterator

import torch
from torch import Tensor

from ghgs_lit import GHGS
from ghgs_lit.cli.inputs import build_data
from ghgs_lit.config import build, compose, resolve
from ghgs_lit.recalibration import Recalibration
from ghgs_lit.recalibration.inspection import attention_on_other_parts
from ghgs_lit.training.pretext.labels import part_shares
from ghgs_lit.types import Points, Tokens

SIZES, SIMILARITIES, DEVIATION = (140, 252), ("none", "product", "log"), 3.0
DATA = [
    "data=synthetic", "data.people={train: 1, val: 12}", "data.render.size=504",
    "data.render.positions=[0,2,4,8,12]", "data.render.views=[0,3]", "targets.training_views=[3]",
]  # fmt: skip

Seen = tuple[Tokens, Points, Tensor]


@torch.no_grad()
def seen_by(model: GHGS, size: int) -> Iterator[Seen]:
    """What the recalibration sees of each batch, and the shares of the parts in the patch of each token."""
    data = build_data(resolve(compose("train", [*DATA, f"data.size={size}"])))
    data.prepare_data(["val"])
    kept: list[tuple] = []
    hook = model.recalibration.register_forward_pre_hook(lambda _, inputs: kept.append(inputs))
    for batch in data.evaluation_loader(views=4, targets=[], split="val"):
        model(batch)
        tokens, points = kept.pop()
        shares = part_shares(batch, tokens.patch_size)
        _, _, h, w = tokens.grid
        yield tokens, points, shares[(tokens.image * h + tokens.row) * w + tokens.column]
    hook.remove()


def deviation(stage: Recalibration, seen: list[Seen]) -> float:
    """Standard deviation of the products of queries and keys over sqrt(d)."""
    block, found = stage.block, []
    for tokens, points, _ in seen:
        for layer in tokens.latent:
            normed = block.norm1(layer[stage.takes_part(points)])
            heads = (
                p(normed).unflatten(1, (block.num_heads, -1)).transpose(0, 1)
                for p in (block.q_proj, block.k_proj)
            )
            q, k = heads
            found.append((q @ k.mT / q.shape[-1] ** 0.5).std())
    return torch.stack(found).mean().item()


@torch.no_grad()
def cells(stage: Recalibration, seen: list[Seen]) -> list[str]:
    """Shares of attention: without features, then with each similarity, own and true features."""
    own = stage.block.similarity
    found = []
    for similarity in SIMILARITIES:
        stage.block.similarity = similarity
        for is_true in (False, True)[: 1 + (similarity != "none")]:
            values = []
            for tokens, points, shares in seen:
                chosen = dataclasses.replace(tokens, semantic=shares.sqrt()) if is_true else tokens
                part = shares.argmax(1).where(shares.any(1), -1)
                values.append(attention_on_other_parts(stage, chosen, points, part))
            found.append(f"{torch.cat(values).mean():.1%}")
    stage.block.similarity = own
    return found


def main() -> None:
    print("| size | k | weights | deviation of logits | s = 1 | product, own | true | log, own | true |")
    print("|---" * 9 + "|")
    for size in SIZES:
        for number, path in enumerate(sys.argv[1:] or ["shipped"]):
            model = GHGS.from_checkpoint(path)
            torch.manual_seed(0)
            seen = list(seen_by(model, size))
            stages = {path: model.recalibration}
            if number == 0:
                width = seen[0][0].latent[0].shape[1]
                stages["untrained"] = build(model.config["recalibration"], "recalibration", dim_latent=width)
            for name, stage in stages.items():
                for is_scaled in (False, True):
                    scale = deviation(stage, seen)
                    if is_scaled:
                        factor = DEVIATION / scale
                        stage.block.q_proj.weight.data *= factor
                        stage.block.q_proj.bias.data *= factor
                        scale = DEVIATION
                    row = [str(size), str(stage.k), name, f"{scale:.2f}", *cells(stage, seen)]
                    print("| " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
