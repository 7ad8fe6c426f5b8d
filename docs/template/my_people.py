"""A data set of your own: a reader that finds photographs on disk, and its options.

Copy this file and ``conf/data/my_people.yaml``, then change what is marked. As it stands it reads
``<root>/<train|val>/<person>/<camera>.png`` (RGBA, alpha is the mask) with ``cameras.npz`` beside
them: ``intrinsics`` [n, 3, 3] in pixels and ``extrinsics`` [n, 3 or 4, 4], world to camera, in
metres, OpenCV axes.
"""

from pathlib import Path
from typing import ClassVar

import numpy as np

from ghgs_lit.config import register
from ghgs_lit.data.dataset import DataSet
from ghgs_lit.data.decoding import check_extrinsics, check_intrinsics, check_name, read_array, read_image
from ghgs_lit.data.reader import Reader
from ghgs_lit.data.view import View
from ghgs_lit.errors import InputError, require


class MyReader(Reader):
    """The photographs of one phase as they are stored."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder
        # CHANGE: every subject (a person, or a frame of one) and the numbers of its cameras.
        people = sorted(p for p in folder.iterdir() if p.is_dir()) if folder.is_dir() else []
        for person in people:
            cameras = sorted(int(p.stem) for p in person.glob("*.png"))
            self.subjects[check_name(person.name)] = tuple(cameras)
        if not self.subjects:
            raise InputError(f"{folder}: expected a folder for each person; found none")

    def read_view(self, name: str, position: int, view: int, depth: bool) -> View:
        # CHANGE: one photograph as it is stored. Resizing and caching are done for you; `view` is 0
        # with static cameras.
        path = self.folder / name / f"{position}.png"
        image = read_image(path)
        require(image.mode == "RGBA", str(path), "an image with an alpha channel", image.mode)
        pixels = np.asarray(image)
        mask = pixels[..., 3] > 127
        cameras = self.folder / name / "cameras.npz"
        if not cameras.is_file():
            raise InputError(f"{cameras}: expected the cameras of {name}; found no such file")
        with np.load(cameras) as stored:
            intrinsics = check_intrinsics(cameras, stored["intrinsics"][position])
            extrinsics = check_extrinsics(cameras, stored["extrinsics"][position])
        # CHANGE: pixel centres lie at +0.5 here. A calibration made with OpenCV puts them at
        # integers: intrinsics[:2, 2] += 0.5
        return View(
            image=pixels[..., :3] * mask[..., None],  # on black
            mask=mask,
            # CHANGE: uint16, 2^15 / metres, 0 where unknown (data.view.encode_depth)
            inverse_depth=None,
            intrinsics=intrinsics.astype(np.float32),
            extrinsics=extrinsics.astype(np.float32),
        )

    def read_body(self, name: str) -> np.ndarray | None:
        # CHANGE: vertices [n, 3] of any body model in the world, for the Chamfer loss;
        # None without one.
        path = self.folder / name / "body.npy"
        return read_array(path, [(None, 3)]).astype(np.float32) if path.exists() else None

    def place(self, name: str, position: int, view: int) -> str:
        return str(self.folder / name / f"{position}.png")


@register("data", "my_people")
class MyPeople(DataSet):
    """The options. `root`, `size` and so on are there already;
    CHANGE: add fields of your own."""

    static_cameras: ClassVar[bool] = True  # CHANGE: False if there are views between the cameras
    ring: ClassVar[int] = 8  # CHANGE: number of cameras; inputs are evenly spaced among them

    def reader(self, phase: str) -> MyReader:
        return MyReader(self.folder / phase)
