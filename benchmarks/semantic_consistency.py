"""Does semantic consistency help where it should? s = 1, Eq. 3 and `log`, trained alike, in pairs of seeds.

    python benchmarks/semantic_consistency.py runs/consistency --steps 60 --seeds 5 [--features pretext.ckpt]
    python benchmarks/semantic_consistency.py runs/consistency --report

The shipped encoder, hull and depths are frozen and the rounds left out: what the recalibration gives is what
one sees. Once, the Gaussian head learns to do without attention. From these weights every arm goes on, with
new queries, keys and values (the seed's, as is the order of people), queries scaled to logits of deviation 3,
where a factor can act, and an output of 0; `off` goes on without attention, `shuffled` with tokens in a
random order. Features are `true`, those of a branch that knows the shares of the parts (the most that part
features can give), or of a checkpoint of `ghgs pretext`. Training: people in poses of sport and dance, 3 of 4
views, half of the time with cameras off by up to 6 pixels, 252 x 252. Runs that are done are not done again.
"""

import argparse
import copy
import dataclasses
import json
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from attention_on_parts import deviation
from part_awareness import of_checkpoint
from torch import Tensor, nn

from ghgs_lit import GHGS
from ghgs_lit.cli.inputs import build_data, build_renderer
from ghgs_lit.config import build, compose, resolve
from ghgs_lit.config.compose import read_option
from ghgs_lit.data.augmentation import Augmentation
from ghgs_lit.encoder.packing import KeptPatches
from ghgs_lit.evaluation.tables.significance import compare
from ghgs_lit.geometry.masks import patches_around_subject
from ghgs_lit.geometry.padding import bounds_of
from ghgs_lit.metrics.functional import box_of, psnr
from ghgs_lit.recalibration.inspection import attention_on_other_parts
from ghgs_lit.rounds.rounds import State, prediction_of
from ghgs_lit.surroundings import Surrounding, computing, surroundings
from ghgs_lit.training.optimization import Optimization
from ghgs_lit.training.pretext.labels import part_shares, token_parts
from ghgs_lit.types import Batch, DepthMaps, Points, Prediction, Rendering, Tokens

ARMS, DEVIATION, OFF = ("none", "product", "log", "off", "shuffled"), 3.0, 6.0
DATA = [
    "data=synthetic", "data.size=252", "data.people={train: 1, val: 14}", "data.active={train: 40, val: 14}",
    "data.render.positions=[0,2,4,8,12]", "data.render.views=[0,3]", "data.render_workers=1",
    "targets.training_views=[3]", "loss=depth", "loss.weights.depth=0",
]  # fmt: skip
#: What is measured: first letter of the people's names, input views, pixels that cameras are off by at most.
CONDITIONS = {
    "active people, 3 views, cameras off": ("a", [0, 1, 2], OFF),
    "standing people, 4 views": ("p", [0, 1, 2, 3], 0.0),
}
SCHEDULE = {"lr": 1e-3, "matrix_scale": 2.5, "betas": (0.9, 0.98), "warmup": 0.05, "end_factor": 0.0}


@dataclasses.dataclass(frozen=True)
class Seen:
    """A batch, what recalibration and Gaussian head see of it, and the part that each token shows."""

    given: Batch
    around: Sequence[Surrounding]
    batch: Batch
    tokens: Tokens
    points: Points
    depths: DepthMaps
    part: Tensor


class Experiment:
    """The model of the arms, its frozen stages' results, and its data."""

    def __init__(self, features: str):
        config = resolve(compose("train", DATA))
        self.data = build_data(config)
        self.data.prepare_data()
        self.model = GHGS.from_checkpoint("shipped")
        self.renderer = build_renderer(config, torch.device("cpu"))
        self.losses = build(config["loss"], "loss")
        self.features = None if features == "true" else of_checkpoint(features)

    @torch.no_grad()
    def seen(self, subject: str, split: str, views: list[int], off: float, seed: int) -> Seen:
        """What the frozen stages make of some of four views whose cameras are off by up to ``off`` pixels."""
        model, targets = self.model, [read_option("targets", name) for name in ("release", "midway")]
        true = self.data.evaluation_batch(subject, split, 4, targets).of_views(views)
        given = Augmentation(calibration=off).imperfections(true, [np.random.default_rng(seed)])
        batch, around = given, surroundings(model.options, model.encoder.patch_size, True)
        for layer in around:
            batch = layer.enter(batch)
        with computing("inherit", model.auto, model.encoder, batch.masks) as (_, kept):
            bounds = bounds_of(model.bounds, batch)
            tokens = model._encode(batch, bounds, kept)
        depths = model.depth_head(tokens, batch, bounds, "subject")
        points = model.unprojection(depths, tokens, batch)
        shares = part_shares(true, tokens.patch_size)
        features = shares.sqrt()
        if self.features is not None:
            shown = KeptPatches(patches_around_subject(true.masks, tokens.patch_size, 0), torch.device("cpu"))
            found = self.features(true, shown)
            features = found.new_zeros(len(shares), found.shape[1]).index_copy(0, shown.index, found)
        place = (tokens.image * tokens.grid[2] + tokens.row) * tokens.grid[3] + tokens.column
        tokens = dataclasses.replace(tokens, semantic=features[place])
        return Seen(
            dataclasses.replace(given),
            around,
            dataclasses.replace(batch),
            tokens,
            points,
            depths,
            token_parts(shares, tokens),
        )

    def prepare(self) -> tuple[list[Seen], dict[str, list[Seen]]]:
        """Of the people of training, and of each condition's."""
        rng = np.random.default_rng(0)
        pool = [
            self.seen(subject, "train", np.sort(rng.permutation(4)[:3]).tolist(), OFF * (k % 2), k)
            for k, subject in enumerate(self.data.subjects("train"))
        ]
        people = list(enumerate(self.data.subjects("val")))
        sets = {
            name: [self.seen(s, "val", views, off, 1000 + k) for k, s in people if s.startswith(letter)]
            for name, (letter, views, off) in CONDITIONS.items()
        }
        return pool, sets

    def rendered(self, seen: Seen) -> tuple[Rendering, Prediction]:
        """The targets of a batch, and the prediction that they show."""
        model, head, rest = self.model, self.model.gaussian_head, (seen.batch, seen.points, seen.depths)
        raw = head(model.recalibration(seen.tokens, seen.points), *rest, "subject")
        prediction = prediction_of((State(raw, head.activate(raw, *rest), seen.points, seen.depths),), False)
        for layer in reversed(seen.around):
            prediction = layer.leave(prediction)
        return self.renderer(prediction.gaussians, seen.given.targets.cameras), prediction

    def train(self, pool: Sequence[Seen], steps: int, seed: int, has_attention: bool) -> None:
        """Train recalibration and Gaussian head; without attention its output stays 0."""
        model, order = self.model, np.random.default_rng(seed)
        model.requires_grad_(False)
        model.gaussian_head.requires_grad_(True)
        model.recalibration.requires_grad_(True)
        if not has_attention:
            for part in attention(model):
                part.requires_grad_(False)
        optimization = Optimization(**SCHEDULE)
        optimizer = optimization.optimizer(model)
        for step in range(steps):
            seen = pool[order.integers(len(pool))]
            for group in optimizer.param_groups:
                group.setdefault("highest", group["lr"])
                group["lr"] = group["highest"] * optimization.factor(step / steps)
            targets = seen.given.targets.of_protocol(("release", "midway")[order.integers(2)])
            seen = dataclasses.replace(seen, given=dataclasses.replace(seen.given, targets=targets))
            rendering, prediction = self.rendered(seen)
            loss = self.losses(prediction, rendering, seen.given)[0]
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(model.parameters(), optimization.clip)
            optimizer.step()

    @torch.no_grad()
    def share(self, seen: Sequence[Seen]) -> float:
        """Share of attention on other parts of the body."""
        stage = self.model.recalibration
        found = [attention_on_other_parts(stage, s.tokens, s.points, s.part) for s in seen]
        return float(torch.cat(found).mean())

    @torch.no_grad()
    def measure(self, sets: dict[str, list[Seen]]) -> list[dict]:
        """PSNR of each target: of the whole image and in the subject's box."""
        rows = []
        for name, seen in sets.items():
            for one in seen:
                targets = one.given.targets
                flat = (self.rendered(one)[0].image[0], targets.images[0])
                whole, box = psnr(*flat), psnr(*flat, box_of(targets.masks[0]))
                rows += [
                    {"condition": name, "subject": one.given.subjects[0], "targets": protocol,
                     "psnr": whole[k].item(), "psnr_box": box[k].item()}
                    for k, protocol in enumerate(targets.protocols)
                ]  # fmt: skip
        return rows


def attention(model: GHGS) -> list[nn.Module]:
    """The projections of the recalibration."""
    block = model.recalibration.block
    return [block.q_proj, block.k_proj, block.v_proj, block.o_proj]


def shuffled(stage: nn.Module, inputs: tuple, tokens: Tokens) -> Tokens:
    """Tokens that say nothing about their place."""
    order = torch.randperm(len(tokens.row))
    return dataclasses.replace(tokens, latent=tuple(layer[order] for layer in tokens.latent))


def begin(model: GHGS, state: dict[str, Tensor], arm: str, seed: int, seen: Seen) -> None:
    """The common weights, and a seed's new attention that changes nothing yet."""
    model.load_state_dict(state)
    torch.manual_seed(seed)
    for part in attention(model):
        part.reset_parameters()
    block = model.recalibration.block
    block.similarity = arm if arm in ("product", "log") else "none"
    for values in block.o_proj.parameters():
        nn.init.zeros_(values)
    scale = DEVIATION / deviation(model.recalibration, [(seen.tokens, seen.points, seen.part)])
    for values in block.q_proj.parameters():
        values.data *= scale


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--first-steps", type=int, default=80, help="of the common weights")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--arms", nargs="+", default=ARMS, choices=ARMS)
    parser.add_argument("--features", default="true")
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    if options.report:
        report(options.runs)
        return
    torch.set_num_threads(1)
    torch.manual_seed(0)
    options.runs.mkdir(parents=True, exist_ok=True)
    name = Path(options.features).stem
    todo = [(seed, arm) for seed in range(1, options.seeds + 1) for arm in options.arms]
    todo = [(s, a) for s, a in todo if not (options.runs / f"{name}_{a}_{s}.json").exists()]
    own, kept = Experiment(options.features), options.runs / f"{name}.pt"
    if not kept.exists():
        torch.save(own.prepare(), kept)
    pool, sets = torch.load(kept, weights_only=False)  # what is above wrote it
    common, looked = options.runs / "common.pt", next(iter(sets.values()))
    if not common.exists():
        nn.init.zeros_(own.model.recalibration.block.o_proj.weight)
        nn.init.zeros_(own.model.recalibration.block.o_proj.bias)
        print("common before", pd.DataFrame(own.measure(sets)).psnr_box.mean(), flush=True)
        own.train(pool, options.first_steps, 0, has_attention=False)
        torch.save(own.model.state_dict(), common)
        print("common after", pd.DataFrame(own.measure(sets)).psnr_box.mean(), flush=True)
    state = copy.deepcopy(torch.load(common, weights_only=True))
    for seed, arm in todo:
        started, some = time.process_time(), looked[:4]
        begin(own.model, state, arm, seed, looked[0])
        before = own.share(looked)
        hook = own.model.recalibration.register_forward_hook(shuffled) if arm == "shuffled" else None
        own.train(pool, options.steps, seed, has_attention=arm != "off")
        content = {
            "arm": arm, "seed": seed, "features": name, "steps": options.steps, "before": before,
            "after": own.share(looked), "rows": own.measure(sets), "seconds": time.process_time() - started,
            "deviation": deviation(own.model.recalibration, [(s.tokens, s.points, s.part) for s in some]),
        }  # fmt: skip
        if hook is not None:
            hook.remove()
        (options.runs / f"{name}_{arm}_{seed}.json").write_text(json.dumps(content))
        print({key: value for key, value in content.items() if key != "rows"}, flush=True)


def report(runs: Path) -> None:
    """Print mean values, differences from s = 1 with intervals, and shares of attention."""
    found = [json.loads(file.read_text()) for file in sorted(runs.glob("*.json"))]
    rows = pd.concat([pd.DataFrame(one.pop("rows")).assign(**one) for one in found])
    for (features, condition, targets), part in rows.groupby(
        ["features", "condition", "targets"], sort=False
    ):
        tables = {
            arm: own.pivot(index="seed", columns="subject", values="psnr_box")
            for arm, own in part.groupby("arm", sort=False)
        }
        for arm, table in tables.items():
            result, mean = compare(table, tables["none"]), table.to_numpy().mean()
            print(
                f"| {features} | {condition} | {targets} | {arm} | {mean:.2f} | {result.difference:+.3f} "
                f"({result.low:+.3f} to {result.high:+.3f}) | {result.p:.2g} | {result.seeds} |"
            )
    print(
        pd.DataFrame(found).groupby(["features", "arm"])[["before", "after", "deviation", "seconds"]].mean()
    )


if __name__ == "__main__":
    main()
