"""Shared by the tests of data sets: cached miniatures, broken files, and checks of views."""

import dataclasses
import functools
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image
from scipy.ndimage import binary_dilation

from ghgs_lit.config import build, compose
from ghgs_lit.data.packed import Packs
from ghgs_lit.data.reader import Photographs, Reader
from ghgs_lit.data.view import View, resize_view
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.types import Cameras
from ghgs_people import figures

_person = functools.lru_cache(figures.generate)


def make_miniature(miniature, *arguments, **options) -> list[Path]:
    """``miniature.make(...)``, with people that are generated once per process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(miniature.figures, "generate", _person)
        return miniature.make(*arguments, **options)


@functools.lru_cache
def _config(*overrides: str):
    return compose("train", ["targets=cameras", *overrides])


def build_data(name: str, root: Path, *overrides: str):
    """The data module of ``data=<name> data.root=<root>``."""
    cfg = _config(f"data={name}", *overrides)
    place = {} if any(o.startswith("data.root=") for o in overrides) else {"root": str(root)}
    node = OmegaConf.to_container(cfg.data, resolve=True) | place
    return build(node, "data", views=cfg.views, targets=cfg.targets, seed=0)


def stored(data, phase: str, size: tuple[int, int] | None = None) -> Photographs:
    """The photographs of a data module, at their stored size unless ``size`` is given."""
    return Photographs(data.dataset.reader(phase), size)


def camera_of(view: View) -> Cameras:
    """The camera of a photograph."""
    matrices = torch.from_numpy(view.intrinsics), torch.from_numpy(view.extrinsics)
    return Cameras(*matrices, *view.mask.shape)


def points_of(view: View) -> np.ndarray:
    """World points [h, w, 3] of the depth map of a photograph."""
    return unproject_maps(torch.from_numpy(view.depth), camera_of(view)).numpy()


def require_same_packed(reader: Reader, folder: Path, size: tuple[int, int]) -> None:
    """Check that photographs from packed files in ``folder`` equal those of a reader bit by bit."""
    packed = Packs(reader, folder, size, "area", (0,), False)
    for name, positions in reader.subjects.items():
        for position in positions:
            found = packed.view(name, position, 0, False)
            assert found is not None
            expected = resize_view(reader.read_checked_view(name, position, 0, False), size)
            for field in dataclasses.fields(View):
                np.testing.assert_array_equal(getattr(found, field.name), getattr(expected, field.name))


class Malice:
    """Runs a command if its pickle is loaded without restrictions."""

    def __reduce__(self):
        return os.system, ("touch ran",)


def refused(line: str, read: Callable[[], object]) -> None:
    """Check that ``read`` raises InputError with one matching line, and that no pickle ran in this folder."""
    with pytest.raises(InputError, match=line) as caught:
        read()
    assert "\n" not in str(caught.value)
    assert not Path("ran").exists()


def inside(view: View, points: np.ndarray) -> float:
    """Share of world points that project into the view's mask, or onto a pixel next to it."""
    local = points @ view.extrinsics[:3, :3].T + view.extrinsics[:3, 3]
    pixels = local @ view.intrinsics.T
    columns, rows = np.floor(pixels[:, :2] / pixels[:, 2:]).astype(int).T
    height, width = view.mask.shape
    framed = (local[:, 2] > 0) & (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    near = binary_dilation(view.mask, np.ones((3, 3)))
    return float(near[rows[framed], columns[framed]].sum() / len(points))


def blob(height: int, width: int, x: float, y: float) -> np.ndarray:
    """[h, w, 3] uint8: a spot at ``x``, ``y``, with pixel centres at integers, as in OpenCV."""
    rows, columns = np.mgrid[:height, :width]
    spot = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 3.0**2))
    return np.repeat(np.round(255 * spot)[..., None], 3, -1).astype(np.uint8)


def centroid(image: np.ndarray) -> np.ndarray:
    """Centroid x, y of an image's light, with pixel centres at +0.5."""
    weight = image[..., 0].astype(np.float64)
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    return np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()


def project(view: View, point: np.ndarray) -> np.ndarray:
    """Pixel x and y of a world point."""
    pixel = view.intrinsics @ (view.extrinsics[:3, :3] @ point + view.extrinsics[:3, 3])
    return pixel[:2] / pixel[2]


def truncate(path: Path, share: float = 0.5) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])


def shrink(path: Path) -> None:
    """Halve the size of an image file, like a user who saves space."""
    image = Image.open(path)
    image.resize((image.width // 2, image.height // 2), Image.Resampling.NEAREST).save(path)


def blank(path: Path) -> None:
    """Replace an image file by a black one of the same size and mode."""
    image = Image.open(path)
    Image.new(image.mode, image.size).save(path)
