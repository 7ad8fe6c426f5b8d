"""Recalibration where an effect has room: errors of depth by limb and view, which other views contradict.

    ghgs pretext data.people='{train: 1, val: 1}' data.active='{train: 40, val: 12}' data.size=140 \\
        encoder.patch_size=7 trainer.max_steps=400 data.batch_size=2 hydra.run.dir=runs/room/pretext
    python benchmarks/recalibration_room.py check runs/room  # do the switches switch?
    python benchmarks/recalibration_room.py run runs/room    # goes on where it was stopped
    python benchmarks/recalibration_room.py table runs/room

People in action at 140 x 140, 4 views, patches of 7 pixels. The branch of ``ghgs pretext`` is frozen: tokens
are the outputs of its stem and of its three blocks, and the place of the token's point, as of an encoder that
predicted these depths. Depths are 5 to 15 cm off, one error for each part and view, cameras up to 3 pixels.
The recalibration and the Gaussian head (no guide, no limit of offsets) learn to correct both.
"""

import argparse
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Int
from torch import Tensor, nn

from ghgs_lit.data.imperfections import perturb_cameras
from ghgs_lit.geometry.chamfer import nearest
from ghgs_lit.geometry.unprojection import Unprojection, seen_surfaces
from ghgs_lit.method.encoder.block import rotary_tables, run_block
from ghgs_lit.method.encoder.semantic import SemanticBranch, SemanticOptions, features_of
from ghgs_lit.method.heads.gaussian import GaussianHeadOptions
from ghgs_lit.method.plan import Plan, make_plan
from ghgs_lit.method.recalibration import Recalibration, RecalibrationOptions
from ghgs_lit.metrics.functional import psnr
from ghgs_lit.ops.neighbors import neighbor_weights
from ghgs_lit.rendering import Renderer
from ghgs_lit.training.pretext import PARTS, Pretext, part_shares, parts_of_points
from ghgs_lit.types import Batch, Cameras, DepthMaps, Gaussians, Points, Tokens
from ghgs_lit.weights.checkpoint import load_weights
from ghgs_people.datasets import Synthetic

PATCH = 7
SIZE = 140
NEIGHBORS = 16
#: Deviation of the logits of an untrained model.
DEVIATION = 3.0
#: Least and greatest error of depths in metres.
DEPTH_ERROR = 0.05, 0.15
#: Greatest error of cameras in pixels.
CAMERA_ERROR = 3.0
#: Errors of cameras of each person in training.
CAMERA_SETS = 8
#: Channels of a token for each coordinate of its place, and of its residual (0 in all rows but one).
COPIES = 8
#: Neighbours, similarity and space of each row; none, random and ceiling do not depend on the space.
ROWS = {
    "none": ("self", "none", "xyz"),
    "s = 1": ("near", "none", "xyz"),
    "Eq. 3": ("near", "product", "xyz"),
    "log": ("near", "log", "xyz"),
    "same part": ("part", "none", "xyz"),
    "random": ("random", "none", "xyz"),
    "ceiling": ("self", "none", "xyz"),
    "s = 1, image plane": ("near", "none", "image_plane"),
    "Eq. 3, image plane": ("near", "product", "image_plane"),
    "log, image plane": ("near", "log", "image_plane"),
    "same part, image plane": ("part", "none", "image_plane"),
}


@dataclass(frozen=True)
class Person:
    """What all rows share. ``labels``: part of each pixel; ``part``: most frequent part of each token."""

    batch: Batch
    plan: Plan
    tokens: Tokens
    labels: Int[Tensor, "V H W"]
    part: Int[Tensor, " N"]
    truth: Points
    cameras: list[Cameras]


@dataclass(frozen=True)
class Scene:
    """A person with planted errors."""

    person: Person
    batch: Batch
    depth_maps: DepthMaps
    points: Points


class RowRecalibration(Recalibration):
    """The package's recalibration with the neighbours of a row; ``part`` is that of each token."""

    part: Int[Tensor, " N"]

    def __init__(self, row: str, dim_latent: int):
        self.who, similarity, space = ROWS[row]
        options = RecalibrationOptions(k=NEIGHBORS, num_heads=4, similarity=similarity, neighborhood=space)
        super().__init__(options, dim_latent)

    def positions(self, tokens: Tokens, points: Points) -> Tensor:
        """Positions; parts are far apart where only neighbours of the same part count."""
        where = super().positions(tokens, points)
        return torch.cat((where, 1e3 * self.part[:, None]), dim=1) if self.who == "part" else where

    def neighborhood_of(self, tokens, points, index, real=None):
        """As of the package, with the neighbours of the row."""
        found = super().neighborhood_of(tokens, points, index, real)
        count, k = found.near.shape
        if self.who == "self":
            return found._replace(near=torch.arange(count)[:, None])
        if self.who == "random":
            return found._replace(near=torch.rand(count, count).topk(k).indices)
        if self.who == "part":
            part = self.part[index]
            return found._replace(left_out=torch.where(part[found.near] == part[:, None], 0.0, -torch.inf))
        return found


class Model(nn.Module):
    """Recalibration and Gaussian head of a row."""

    def __init__(self, row: str, width: int):
        super().__init__()
        width += 2 * 3 * COPIES
        self.knows_residual = row == "ceiling"
        self.recalibration = RowRecalibration(row, width)
        options = GaussianHeadOptions(offset_limit=None, rectified_skip=False, channels=16, hidden=(32, 32))
        self.head = options.build(width)

    def forward(self, scene: Scene) -> Gaussians:
        plan = scene.person.plan
        tokens = self.recalibration(self.tokens(scene), scene.points, plan)
        raw = self.head(tokens, scene.batch, scene.points, scene.depth_maps, plan)
        return self.head.activate(raw, scene.batch, scene.points, scene.depth_maps)

    def tokens(self, scene: Scene) -> Tokens:
        """Cached tokens with places in units of 25 cm, and residuals in units of 5 cm or 0."""
        person, points = scene.person, scene.points.tokens
        self.recalibration.part = person.part
        places = (points - points.mean(0)) / 0.25
        residual = (person.truth.tokens - points) / 0.05 * self.knows_residual
        more = torch.cat((places, residual), dim=1).repeat(1, COPIES)
        latent = tuple(torch.cat((layer, more), dim=1) for layer in person.tokens.latent)
        return replace(person.tokens, latent=latent)


def encode(branch: SemanticBranch, batch: Batch, plan: Plan) -> Tokens:
    """Outputs of the stem and of each block of the branch, and its features."""
    kept = plan.kept
    images = torch.cat((batch.images, batch.masks[:, :, None]), dim=2).flatten(0, 1)
    x = kept.join(branch.token.expand(len(images), -1, -1), branch.stem(2 * images - 1, kept))
    rotary = rotary_tables(kept.positions(1), branch.head_width, x)
    latent = [kept.take(x, 1)]
    for block in branch.blocks:
        x = run_block(block, x, kept.lengths(1), False, rotary, kept.real_tokens(1))
        latent.append(kept.take(x, 1))
    semantic = features_of(branch.head(branch.norm(latent[-1])).log_softmax(1))
    return Tokens(tuple(latent), semantic, kept.image, kept.row, kept.column, kept.grid, PATCH)


@torch.no_grad()
def prepare(branch: SemanticBranch, batch: Batch) -> Person:
    """Cache what stays the same in all rows."""
    batch = replace(batch, masks=batch.masks & (batch.depths > 0))
    plan = make_plan(batch.masks, PATCH, branch.subject(batch.masks))
    labels = torch.zeros_like(batch.masks, dtype=torch.long)
    labels[batch.masks] = parts_of_points(seen_surfaces(batch)[0], batch.body_vertices[0])
    part = part_shares(batch, PATCH)[plan.kept.index].argmax(1)
    tokens = encode(branch, batch, plan)
    truth = Unprojection()(DepthMaps(batch.depths, batch.masks, batch.depths), tokens, batch)
    cameras = []
    for number in range(CAMERA_SETS):
        rng = np.random.default_rng(number)
        moved = perturb_cameras(batch.cameras[0], batch.masks[0], CAMERA_ERROR, rng)
        cameras.append(replace(moved, intrinsics=moved.intrinsics[None], extrinsics=moved.extrinsics[None]))
    return Person(batch, plan, tokens, labels[0], part, truth, cameras)


def plant(person: Person, rng: np.random.Generator) -> Scene:
    """Plant errors of depths and cameras; every second row and column of pixels has a Gaussian."""
    shape = (person.labels.shape[0], len(PARTS))
    sizes = torch.from_numpy(rng.uniform(*DEPTH_ERROR, shape) * rng.choice((-1, 1), shape)).float()
    errors = sizes.gather(1, person.labels.flatten(1)).view_as(person.labels)
    masks = person.batch.masks
    depth_maps = DepthMaps(person.batch.depths + errors * masks, masks, person.batch.depths)
    batch = replace(person.batch, cameras=person.cameras[rng.integers(CAMERA_SETS)])
    points = Unprojection()(depth_maps, person.tokens, batch)
    sparse = torch.zeros_like(masks)
    sparse[..., ::2, ::2] = True
    return Scene(person, batch, depth_maps, replace(points, valid=masks & sparse))


def read_people(folder: Path) -> list[list[Person]]:
    """Read 40 people to train on, and 12 others."""
    pretext = Pretext(SemanticOptions().build(PATCH))
    load_weights(pretext, folder / "pretext" / "checkpoints" / "last.ckpt")
    data = Synthetic(size=SIZE, people={"train": 1, "val": 1}, active={"train": 40, "val": 12})
    targets = {"kind": "cameras", "name": "between", "view": 0, "positions": [2, 6, 10, 14]}
    module = data.build(views={"evaluation_count": 4}, targets=targets)
    module.prepare_data()
    people = []
    for split in ("train", "val"):
        names = [name for name in module.subjects(split) if name.startswith("a")]
        batches = [module.evaluation_batch(name, split, 4, module.targets) for name in names]
        people.append([prepare(pretext.encoder["semantic"], batch) for batch in batches])
    return people


@torch.no_grad()
def build(row: str, seed: int, scene: Scene) -> Model:
    """Build a model whose logits have the deviation DEVIATION in a scene."""
    torch.manual_seed(seed)
    model = Model(row, scene.person.tokens.latent[0].shape[1])
    block = model.recalibration.block
    normed = block.norm1(torch.cat(model.tokens(scene).latent))
    queries, keys = (
        proj(normed).unflatten(1, (block.num_heads, -1)) for proj in (block.q_proj, block.k_proj)
    )
    logits = torch.einsum("nac,mac->anm", queries, keys) * keys.shape[2] ** -0.5
    for parameter in block.q_proj.parameters():
        parameter *= DEVIATION / logits.std()
    return model


def train(row: str, seed: int, steps: int, people: list[Person]) -> Model:
    """Train a row, one person a step; people and errors are the same in all rows of a seed."""
    rng = np.random.default_rng(seed)
    model = build(row, seed, plant(people[0], rng))
    optimizer = torch.optim.AdamW(model.parameters(), lr=2e-3, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, steps + 1, pct_start=0.1)
    for _ in range(steps):
        scene = plant(people[rng.integers(len(people))], rng)
        gaussians = model(scene)
        truth = scene.person.truth.pixels[0].flatten(1, 2)[gaussians.image, gaussians.pixel]
        targets = scene.batch.targets
        view = rng.integers(targets.masks.shape[1])
        cameras = targets.cameras[:, [view]].resize(targets.cameras.height // 2, targets.cameras.width // 2)
        render = Renderer()(gaussians, cameras).image[0, 0]
        loss = 10 * (gaussians.means - truth).norm(dim=1).mean()
        loss = loss + 5 * (render - F.avg_pool2d(targets.images[0, view], 2)).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    return model


@torch.no_grad()
def measure(model: Model, people: list[Person]) -> dict[str, list[float]]:
    """Distance of means to the true surface in mm, and PSNR 45° from the inputs, of each person."""
    values = {"surface_mm": [], "psnr": []}
    torch.manual_seed(0)
    for number, person in enumerate(people):
        gaussians = model(plant(person, np.random.default_rng(number)))
        surface = seen_surfaces(person.batch)[0]
        distance = (gaussians.means - surface[nearest(gaussians.means, surface)]).norm(dim=1).mean()
        targets = person.batch.targets
        values["surface_mm"].append(1000 * distance.item())
        values["psnr"].append(
            psnr(Renderer()(gaussians, targets.cameras).image[0], targets.images[0]).mean().item()
        )
    return values


@torch.no_grad()
def check(person: Person) -> None:
    """Print what rows differ in before training, on the last layer of a person's tokens."""
    scene = plant(person, np.random.default_rng(0))
    index = person.plan.peers.only(scene.points.tokens_valid).index
    part = person.part[index]
    results = {}
    for row in ROWS:
        model = build(row, 1, scene)
        tokens = model.tokens(scene)
        block = model.recalibration.block
        x = tokens.latent[-1][index]
        found = model.recalibration.neighborhood_of(tokens, scene.points, index)
        factor, bias = block.factor_and_bias(found.cosines)
        bias = found.left_out if bias is None else bias
        normed = block.norm1(x)
        queries, keys = block.q_proj(normed), block.k_proj(normed)[found.near]
        weights = neighbor_weights(queries, keys, block.num_heads, factor, bias).mean(-1)
        results[row] = torch.zeros(len(x), len(x)).scatter(1, found.near, weights), block(x, found)
        weights, after = results[row]
        same = (weights * (part == part[:, None])).sum(1).mean()
        shared = ((weights > 0) & (results["none" if row == "none" else "s = 1"][0] > 0)).sum() / (
            weights > 0
        ).sum()
        change = (after - results["none"][1]).norm() / x.norm()
        print(
            f"{row}: {same:.0%} of attention on the same part, {shared:.0%} of neighbours as of s = 1,",
            end=" ",
        )
        print(f"attention changes tokens by {change:.0%}")


def print_table(results: list[dict], rows: list[str]) -> None:
    """Print means over the seeds that all rows have, and shares of the ceiling with 95 % intervals; ``rows``
    include ``none`` and ``ceiling``."""
    values = {(one["row"], one["seed"]): (one["surface_mm"], one["psnr"]) for one in results}
    seeds = [seed for seed in range(100) if all((row, seed) in values for row in rows)]
    table = np.array([[values[row, seed] for seed in seeds] for row in rows])  # row, seed, metric, person
    rng = np.random.default_rng(0)
    draws = []
    for _ in range(2000):
        chosen = table[:, rng.integers(len(seeds), size=len(seeds))]
        draws.append(chosen[..., rng.integers(table.shape[3], size=table.shape[3])].mean((1, 3)))
    means = np.stack([table.mean((1, 3)), *draws])  # draw, row, metric
    none = means[:, [rows.index("none")]]
    shares = (means - none) / (means[:, [rows.index("ceiling")]] - none)
    low, high = np.percentile(shares[1:], (2.5, 97.5), axis=0)
    columns = "| mm | share of the ceiling | PSNR | share of the ceiling |"
    print(f"| row, {len(seeds)} seeds {columns}\n|---|---|---|---|---|")
    for number, row in enumerate(rows):
        cells = []
        for metric in (0, 1):
            interval = f"{low[number, metric]:.1%} to {high[number, metric]:.1%}"
            cells.append(f"{means[0, number, metric]:.2f} | {shares[0, number, metric]:.1%} ({interval})")
        print(f"| {row} | {' | '.join(cells)} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("command", choices=("check", "run", "table"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--rows", nargs="+", default=list(ROWS), choices=list(ROWS))
    given = parser.parse_args()
    path = given.folder / "results.jsonl"
    results = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    if given.command == "table":
        return print_table(results, given.rows)
    trained, held_out = read_people(given.folder)
    if given.command == "check":
        return check(held_out[0])
    done = {(one["row"], one["seed"]) for one in results}
    for seed in range(1, given.seeds + 1):
        for row in [row for row in given.rows if (row, seed) not in done]:
            begin = time.process_time()
            values = measure(train(row, seed, given.steps, trained), held_out)
            result = {"row": row, "seed": seed, **values, "seconds": time.process_time() - begin}
            with path.open("a") as file:
                file.write(json.dumps(result) + "\n")
            print(row, seed, np.mean(values["surface_mm"]), np.mean(values["psnr"]), flush=True)


if __name__ == "__main__":
    main()
