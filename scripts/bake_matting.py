"""Train the matting network: generated people before generated backgrounds, with masks that are wrong.

    python scripts/bake_matting.py --out runs/matting

People are rendered on first use (240 for the network in the package). An interrupted run goes on where its
last checkpoint was. Writes ``ghgs_lit/data/matting/weights.safetensors`` at the end, in half precision.
"""

import argparse
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from lightning import LightningModule, Trainer, seed_everything
from lightning.pytorch.callbacks import ModelCheckpoint
from safetensors.torch import save_file
from scipy.ndimage import gaussian_filter, zoom
from torch.utils.data import DataLoader, IterableDataset

from ghgs_lit.cli.inputs import build_data
from ghgs_lit.config import run_of
from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.data.imperfections import backgrounds, imperfect_mask
from ghgs_lit.data.matting import WEIGHTS, MattingNetwork
from ghgs_lit.files import write_atomically

_CROP = 160
#: Height or width of the subject in pixels; how much photographs are enlarged for it at most.
_SUBJECT, _LARGEST = (170, 330), 1.4
#: Shares of samples: their matte is exact; it is a mask, but otherwise exact;
#: a wrong mask is blurred.
_EXACT, _SHARP, _BLURRED = 0.2, 0.1, 0.2
#: Masks grow or shrink by up to this many pixels,
#: bumps are up to this high and as many times wider than 6.
_OFFSET, _RAGGED, _WIDER = 4.0, 5.0, (1, 1, 2, 3)
_HOLE, _HOLE_CHANCE = 0.12, 0.35
_RATE = 2e-3
#: Steps from one checkpoint to the next.
_KEPT = 200

Sample = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def sample(image: np.ndarray, alpha: np.ndarray, rng: np.random.Generator) -> Sample:
    """A photograph [3, c, c], what is known of its matte [c, c], the matte, the subject on black.

    Args:
        image: the subject on black, premultiplied, [3, h, w] in [0, 1].
        alpha: its matte [h, w].
        rng: random numbers.
    """
    image, alpha = _resized(image, alpha, rng)
    gains = np.exp(rng.uniform(-0.3, 0.3) + rng.uniform(-0.15, 0.15, (3, 1, 1)))
    image = np.minimum(image * gains, alpha)
    if rng.uniform() < 0.3:
        image = image[rng.permutation(3)]
    given = _known(alpha, rng)
    cut = _around_an_outline(alpha, rng)
    image, alpha, given = image[:, *cut], alpha[cut], given[cut]
    photograph = image + (1 - alpha) * _background(image, alpha, rng)
    if rng.uniform() < 0.3:  # an unsharp lens
        photograph = gaussian_filter(photograph, (0, *[rng.uniform(0.2, 0.7)] * 2))
    photograph = photograph + rng.uniform(0, 0.02) * rng.standard_normal(photograph.shape)
    return tuple(part.astype(np.float32) for part in (photograph.clip(0, 1), given, alpha, image))


def _resized(image: np.ndarray, alpha: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.nonzero(alpha > 0.5)
    scale = min(rng.uniform(*_SUBJECT) / (max(np.ptp(rows), np.ptp(columns)) + 1), _LARGEST)
    sides = [max(round(scale * side), _CROP) for side in alpha.shape]
    both = torch.from_numpy(np.concatenate((image, alpha[None])))[None]
    resized = F.interpolate(both, sides, mode="bilinear", antialias=True, align_corners=False)[0].numpy()
    flipped = resized[..., ::-1] if rng.uniform() < 0.5 else resized
    return flipped[:3], flipped[3]


def _known(alpha: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What a capture may say of a matte."""
    kind, wider = rng.uniform(), int(rng.choice(_WIDER))
    if kind < _EXACT:
        return alpha
    limits = (0.0, 0.0) if kind < _EXACT + _SHARP else rng.uniform(0, (_OFFSET, _RAGGED)) / wider
    mask = imperfect_mask(alpha[::wider, ::wider] > 0.5, *limits, _HOLE, _HOLE_CHANCE, rng)
    found = mask.astype(float)
    if wider > 1:
        factors = [whole / side for whole, side in zip(alpha.shape, mask.shape, strict=True)]
        found = (zoom(found, factors, order=1) > 0.5).astype(float)
    return gaussian_filter(found, rng.uniform(0.3, 1.5)) if rng.uniform() < _BLURRED else found


def _around_an_outline(alpha: np.ndarray, rng: np.random.Generator) -> tuple[slice, slice]:
    places = np.argwhere((alpha > 0.02) & (alpha < 0.98))
    middle = places[rng.integers(len(places))] if len(places) else np.array(alpha.shape) // 2
    corner = middle - _CROP // 2 + rng.integers(-40, 41, 2)
    return tuple(
        slice(start, start + _CROP) for start in corner.clip(0, np.array(alpha.shape) - _CROP).tolist()
    )


def _background(image: np.ndarray, alpha: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Clouds, pieces of a room, a slow change or a texture;
    every fourth has a colour of the subject."""
    kind = rng.integers(4)
    if kind == 0:
        found = backgrounds(1, _CROP, _CROP, rng)[0]
    elif kind == 1:
        found = _room(rng)
    else:
        coarse = kind == 2
        cells = int(rng.integers(2, 8) if coarse else rng.integers(8, 80))
        deviation = 0.5 if coarse else rng.uniform(0, 0.5)
        middle = 0.5 if coarse else rng.uniform(0, 1, (3, 1, 1))
        channels = 3 if coarse or rng.uniform() < 0.5 else 1
        patches = rng.uniform(-deviation, deviation, (channels, cells, cells))
        order = 1 if coarse else int(rng.integers(2))
        found = middle + zoom(patches, (1, _CROP / cells, _CROP / cells), order=order)
    found = found + rng.uniform(0, 0.04) * rng.standard_normal((3, _CROP, _CROP))
    inside = image[:, alpha > 0.9].T
    if rng.uniform() < 0.25 and len(inside):
        color = inside[rng.integers(len(inside))]
        found = found + (color[:, None, None] - found.mean((1, 2), keepdims=True))
    return found.clip(0, 1)


def _room(rng: np.random.Generator) -> np.ndarray:
    """Rectangles with sharp edges, in slowly changing light."""
    v, u = np.mgrid[:_CROP, :_CROP]
    found = np.tile(rng.uniform(size=(3, 1, 1)), (1, _CROP, _CROP))
    for _ in range(rng.integers(2, 14)):
        angle, middle, half = rng.uniform(0, math.pi), rng.uniform(0, _CROP, 2), rng.uniform(5, 120, 2)
        along = (v - middle[0]) * math.cos(angle) + (u - middle[1]) * math.sin(angle)
        across = (v - middle[0]) * math.sin(angle) - (u - middle[1]) * math.cos(angle)
        found[:, (np.abs(along) < half[0]) & (np.abs(across) < half[1])] = rng.uniform(size=(3, 1))
    light = rng.uniform(-0.2, 0.2, (2, 3, 1, 1)) / _CROP
    return found + light[0] * v + light[1] * u


class Samples(IterableDataset):
    """Batches of training, each a function of its step:
    one sample of each photograph of a person."""

    def __init__(self, data: PhotographsDataModule, first: int) -> None:
        self.data, self.first = data, first

    def __iter__(self) -> Iterator[tuple[torch.Tensor, ...]]:
        step = self.first
        while True:
            batch, rng = self.data.training_batch(step), np.random.default_rng([1, step])
            pairs = zip(batch.images.flatten(0, 1).numpy(), batch.alpha.flatten(0, 1).numpy(), strict=True)
            samples = [sample(image, alpha, rng) for image, alpha in pairs]
            yield tuple(torch.from_numpy(np.stack(parts)) for parts in zip(*samples, strict=True))
            step += 1


class Training(LightningModule):
    """The sum of the mean errors of mattes and of colours."""

    def __init__(self, data: PhotographsDataModule, steps: int) -> None:
        super().__init__()
        self.data, self.steps = data, steps
        self.network = MattingNetwork().to(memory_format=torch.channels_last)

    def train_dataloader(self) -> DataLoader:
        return DataLoader(Samples(self.data, self.global_step), batch_size=None, num_workers=1)

    def training_step(self, parts: tuple[torch.Tensor, ...]) -> torch.Tensor:
        photographs, given, mattes, subjects = parts
        found, colors = self.network(photographs, given)
        errors = ((found - mattes).abs().mean(), (colors - subjects).abs().mean())
        self.log_dict(dict(zip(("matte", "color"), errors, strict=True)), prog_bar=True)
        return sum(errors)

    def configure_optimizers(self) -> dict:
        optimizer = torch.optim.AdamW(self.network.parameters(), _RATE, weight_decay=1e-4)
        schedule = torch.optim.lr_scheduler.OneCycleLR(
            optimizer, _RATE, total_steps=self.steps, pct_start=0.05
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def train(data: PhotographsDataModule, steps: int, out: Path, weights: Path) -> None:
    """Train to ``steps`` in all, from the last checkpoint in ``out`` if there is one;
    write the weights."""
    training = Training(data, steps)
    last = ModelCheckpoint(out, "last", every_n_train_steps=_KEPT, enable_version_counter=False)
    trainer = Trainer(
        max_steps=steps,
        accelerator="cpu",
        precision="bf16-mixed",
        gradient_clip_val=1.0,
        default_root_dir=out,
        callbacks=[last],
    )
    path = out / "last.ckpt"
    trainer.fit(training, ckpt_path=path if path.exists() else None)
    halves = {name: value.half().contiguous() for name, value in training.network.state_dict().items()}
    write_atomically(weights, lambda temporary: save_file(halves, temporary))
    print(f"{weights}: the network after {trainer.global_step} steps; checkpoints in {out}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=9500, help="in all")
    parser.add_argument("--people", type=int, nargs=2, default=(160, 80), help="standing and in other poses")
    parser.add_argument("--out", type=Path, default=Path("runs/matting"), help="checkpoints and logs")
    parser.add_argument("--weights", type=Path, default=WEIGHTS, help="replaced at the end")
    options = parser.parse_args()
    standing, active = options.people
    overrides = [f"data.people={{train: {standing}, val: 1}}", f"data.active={{train: {active}, val: 0}}"]
    overrides += ["data=synthetic", "data/rig=varied", "data.size=252", "views=random"]
    data = build_data(run_of("train", overrides))
    data.prepare_data(["train"])
    data.trains_on_depths = False
    seed_everything(0)
    train(data, options.steps, options.out, options.weights)


if __name__ == "__main__":
    main()
