"""Part-awareness of semantic features: does the most similar patch of another view show the same body part?

    python benchmarks/part_awareness.py pretext.ckpt shipped data/rig=varied

Measures checkpoints of `ghgs pretext` and of models, beside colours and a branch that has learned nothing,
on validation people; overrides are those of conf/pretext.yaml. A patch's part is that of most of its pixels;
`limbs` does not tell left from right. `true shares` has features as a branch that knows the shares would.
Last: milliseconds of one core for a branch and for the whole encoder around it, of random weights.
"""

import argparse
import time
from collections.abc import Callable

import torch
from einops import rearrange
from torch import Tensor

from ghgs_lit import GHGS
from ghgs_lit.cli.inputs import build_data
from ghgs_lit.config import run_of
from ghgs_lit.execution import Predictor
from ghgs_lit.geometry.masks import patches_around_subject
from ghgs_lit.method.encoder.semantic import SemanticBranch, SemanticOptions
from ghgs_lit.method.plan import planned
from ghgs_lit.method.plan.patches import KeptPatches
from ghgs_lit.training.pretext.labels import PARTS, part_shares
from ghgs_lit.training.pretext.module import neighbor_shows_part
from ghgs_lit.types import Batch, Tokens
from ghgs_lit.weights.checkpoint import model_state, read_checkpoint

Features = Callable[[Batch, KeptPatches], Tensor]


def colors(mean: bool, patch_size: int) -> Features:
    """Colours of a patch's pixels or their mean, against the mean of all patches."""

    def of(batch: Batch, kept: KeptPatches) -> Tensor:
        patches = rearrange(
            batch.images.flatten(0, 1), "n c (h p) (w q) -> (n h w) (p q) c", p=patch_size, q=patch_size
        )[kept.index]
        values = patches.mean(1) if mean else patches.flatten(1)
        return values - values.mean(0)

    return of


def of_branch(branch: SemanticBranch) -> Features:
    """Features of a branch."""
    return lambda batch, kept: branch(batch.images, batch.masks, branch.subject(batch.masks))


def of_model(model: GHGS) -> Features:
    """The semantic features of a whole model."""

    def of(batch: Batch, kept: KeptPatches) -> Tensor:
        found: list[Tokens] = []
        hook = model.encoder.register_forward_hook(lambda module, inputs, tokens: found.append(tokens))
        Predictor(model)(batch)
        hook.remove()
        _, _, h, w = found[0].grid
        flat = (found[0].image * h + found[0].row) * w + found[0].column
        return found[0].semantic[torch.searchsorted(flat, kept.index)]

    return of


def of_checkpoint(path: str) -> Features:
    """Features of a checkpoint of either kind."""
    checkpoint = read_checkpoint(path)
    encoder = checkpoint["config"]["encoder"]
    if "bounds" in checkpoint["config"]:
        return of_model(Predictor.from_checkpoint(path).model)
    branch = SemanticOptions(**encoder["semantic"]).build(encoder["patch_size"])
    prefix, state = "encoder.semantic.", model_state(checkpoint)
    branch.load_state_dict({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})
    return of_branch(branch.eval())


def merged_sides() -> Tensor:
    """The number of each part where left and right are one."""
    names = [part.removeprefix("left ").removeprefix("right ") for part in PARTS]
    return torch.tensor([names.index(name) for name in names])


def fastest(call: Callable[[], object], repeats: int = 30) -> float:
    """The least CPU seconds of a call with one thread, which other processes disturb little."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return min(times)


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("arguments", nargs="*", help="checkpoints, and overrides (<key>=<value>)")
    arguments = parser.parse_args().arguments
    run = run_of("pretext", ["data.batch_size=1", *(a for a in arguments if "=" in a)])
    patch_size = run.encoder.patch_size
    torch.manual_seed(0)
    untrained = run.encoder.semantic.build(patch_size).eval()
    rows: dict[str, Features] = {
        "mean colour": colors(True, patch_size),
        "colours": colors(False, patch_size),
        "untrained branch": of_branch(untrained),
    }
    rows |= {path: of_checkpoint(path) for path in arguments if "=" not in path}
    data, limbs = build_data(run), merged_sides()
    data.prepare_data(["val"])
    right = {name: torch.zeros(2) for name in [*rows, "true shares"]}
    count = 0
    for batch in data.val_dataloader():
        kept = KeptPatches(patches_around_subject(batch.masks, patch_size, 0), batch.images.device)
        shares = part_shares(batch, patch_size)[kept.index]
        known, part = shares.any(1), shares.argmax(1)
        count += int(known.sum())
        for name, features in {**rows, "true shares": lambda *_, shares=shares: shares.sqrt()}.items():
            values = features(batch, kept)
            for column, parts in enumerate((part, limbs[part])):
                shown = neighbor_shows_part(values[known], parts[known], kept.image[known])
                right[name][column] += shown.sum()
    print(f"{count} patches of {len(data.subjects('val'))} people, {run.views.evaluation_count} views")
    print("| features | parts | limbs |\n|---|---|---|")
    for name, found in right.items():
        print(f"| {name} | {found[0] / count:.1%} | {found[1] / count:.1%} |")
    torch.set_num_threads(1)
    encoder = run.encoder.build().eval()
    plan = planned(batch.masks, patch_size, encoder.keeps(batch.masks))
    branch = fastest(lambda: encoder.semantic(batch.images, batch.masks, plan))
    whole = fastest(lambda: encoder(batch.images, batch.masks))
    size = tuple(batch.images.shape)
    print(f"the branch takes {1e3 * branch:.1f} of the encoder's {1e3 * whole:.1f} ms, photographs {size}")


if __name__ == "__main__":
    main()
