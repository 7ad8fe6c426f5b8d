"""The layout on disk of rendered THuman2.0 data: writing it, and reading ours and other people's.

``<root>/<phase>/`` with phase ``train`` or ``val`` holds, for ring position ``pid`` and view ``vid``::

    img/<id>_<pid:03d>/<vid>.jpg             photograph on black (.png is read too)
    mask/<id>_<pid:03d>/<vid>.png            subject where channel 0 is above half of its maximum
    depth/<id>_<pid:03d>/<vid>.png           optional; uint16, 2^15 / z, 0 where there is none
    parm/<id>_<pid:03d>/<vid>_intrinsic.npy  3 x 3 in pixels of the stored image
    parm/<id>_<pid:03d>/<vid>_extrinsic.npy  3 x 4 or 4 x 4, world to camera, metres, OpenCV axes
    smpl/<id>/vertices.npy                   optional (or smplx/): vertices of the body [n, 3]
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ghgs_lit.data.progress import Progress
from ghgs_lit.data.reader import (
    DEPTH_SCALE,
    Reader,
    View,
    check_extrinsics,
    check_intrinsics,
    read_array,
    read_image,
    read_map,
    rgb,
)
from ghgs_lit.errors import InputError, choice

PHASES = ("train", "val")
_IMAGE_SUFFIXES = (".jpg", ".png", ".jpeg")
_POSITION = re.compile(r"(.+)_(\d{3,})")


def encode_depth(depth: np.ndarray) -> np.ndarray:
    """Metres to uint16 inverse depth; 0 stays 0. At 2 m a step is 0.12 mm; nearer than 0.5 m saturates."""
    known = depth > 0
    inverse = np.round(DEPTH_SCALE / np.where(known, depth, 1))
    return np.where(known, np.clip(inverse, 1, 65535), 0).astype(np.uint16)


def write_view(phase: Path, position: str, vid: int, view: View, quality: int = 98) -> None:
    """Write one view below the folder ``phase``; the JPEG keeps full colour resolution."""
    folders = {kind: phase / kind / position for kind in ("img", "mask", "depth", "parm")}
    for folder in folders.values():
        folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(view.image).save(folders["img"] / f"{vid}.jpg", quality=quality, subsampling=0)
    Image.fromarray(view.mask.astype(np.uint8) * 255).save(folders["mask"] / f"{vid}.png")
    if view.inverse_depth is not None:
        Image.fromarray(view.inverse_depth).save(folders["depth"] / f"{vid}.png")
    np.save(folders["parm"] / f"{vid}_intrinsic.npy", view.intrinsics.astype(np.float64))
    np.save(folders["parm"] / f"{vid}_extrinsic.npy", view.extrinsics[:3].astype(np.float64))


def write_body(phase: Path, name: str, vertices: np.ndarray) -> None:
    folder = phase / "smpl" / name
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "vertices.npy", vertices.astype(np.float32))


def position_name(name: str, pid: int) -> str:
    return f"{name}_{pid:03d}"


def read_camera(folder: Path, vid: int) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics [3, 3] and extrinsics [4, 4] in float64.

    Raises:
        InputError: a file is bad, a focal length is not above 0, the rotation is none.
    """
    path = folder / f"{vid}_intrinsic.npy"
    intrinsics = check_intrinsics(path, read_array(path, [(3, 3)]))
    path = folder / f"{vid}_extrinsic.npy"
    return intrinsics, check_extrinsics(path, read_array(path, [(3, 4), (4, 4)]))


class Layout(Reader):
    """Subjects of one phase of a rendered data set, read at ``size``.

    ``subjects`` maps names (of ``names``, or all that there are; the first ``limit`` of them) to the ring
    positions that exist. ``names`` that the folder of the phase lacks are looked for in the other one: a
    split may be another than the one that the folders were made for. ``pixel_centers`` says where the
    renderer that made the files put pixel centres: ``half`` (+0.5, ours), ``integer`` (the published
    THuman2.0 scripts), or ``auto``: integer where the files were not rendered by this package.

    Raises:
        InputError: the root or phase is missing, empty, not wholly rendered, or lacks one of ``names``.
    """

    def __init__(
        self,
        root: str | Path,
        phase: str,
        size: tuple[int, int] | None = None,
        names: Sequence[str] | None = None,
        limit: int | None = None,
        pixel_centers: str = "half",
        body_models: Sequence[str] = ("smpl", "smplx"),
        cache_mb: float = 0,
        strict: bool = True,
    ) -> None:
        super().__init__(size, cache_mb, strict)
        choice("data.pixel_centers", pixel_centers, ("half", "integer", "auto"))
        self.root, self.body_models = Path(root).expanduser(), tuple(body_models)
        self._progress = Progress(self.root)
        if pixel_centers == "auto":
            pixel_centers = "half" if self._progress.tracked else "integer"
        self._shift = 0.5 if pixel_centers == "integer" else 0.0
        self._folders: dict[str, Path] = {}
        self._find(phase, names, limit)

    def _find(self, phase: str, names: Sequence[str] | None, limit: int | None) -> None:
        """Fill ``subjects`` with those that are whole."""
        if not self.root.is_dir():
            raise InputError(f"{self.root}: expected the root of a rendered data set; found no such folder")
        phases = [phase] if names is None else [phase, *(p for p in PHASES if p != phase)]
        found = {p: _positions(self.root / p / "img") for p in phases}
        images = self.root / phase / "img"
        if not any(found.values()) and not images.is_dir():
            raise InputError(
                f"{images}: expected a folder <id>_<position> for every camera; found no such folder"
            )
        planned = self._progress.planned(phase)
        wanted = (sorted({*found[phase], *planned}) if names is None else list(names))[:limit]
        homes = {name: next((p for p in phases if name in found[p]), phase) for name in wanted}
        missing = [
            name
            for name, home in homes.items()
            if name not in found[home] or self._progress.missing(home, [name])
        ]
        if missing and self.strict:
            raise InputError(
                f"{images}: expected {len(wanted)} whole subjects; found {len(wanted) - len(missing)} "
                f"({missing[0]} is missing or half-rendered: render again to finish)"
            )
        for name in missing:
            self.problem(f"{images / name}_000: expected a whole subject; found none, or a half-rendered one")
        if not wanted:
            self.problem(f"{images}: expected folders <id>_<position>; found none")
        for name in (n for n in wanted if n not in missing):
            self.subjects[name] = tuple(sorted(found[homes[name]][name]))
            self._folders[name] = self.root / homes[name]

    def place(self, name: str, pid: int, vid: int) -> str:
        return str(self._folders[name] / "mask" / position_name(name, pid) / f"{vid}.png")

    def vids(self, name: str, pid: int) -> list[int]:
        """Views that have a photograph at a position."""
        files = (self._folders[name] / "img" / position_name(name, pid)).iterdir()
        return sorted(int(p.stem) for p in files if p.suffix in _IMAGE_SUFFIXES and p.stem.isdecimal())

    def read_body(self, name: str) -> np.ndarray | None:
        for model in self.body_models:
            path = self._folders[name] / model / name / "vertices.npy"
            if path.exists():
                return read_array(path, [(None, 3)]).astype(np.float32)
        return None

    def read_view(self, name: str, pid: int, vid: int, depth: bool) -> View:
        position, folder = position_name(name, pid), self._folders[name]
        stem = folder / "img" / position / str(vid)
        paths = [stem.with_suffix(suffix) for suffix in _IMAGE_SUFFIXES]
        image = read_image(next((path for path in paths if path.exists()), paths[0]))
        size = (image.height, image.width)
        mask = read_map(folder / "mask" / position / f"{vid}.png", size)
        path = folder / "depth" / position / f"{vid}.png"
        inverse = None
        if depth and path.exists():
            inverse = read_map(path, size)
            if inverse.dtype == np.uint8:
                raise InputError(f"{path}: expected 16 bits of inverse depth; found 8")
            inverse = inverse.astype(np.uint16)
        intrinsics, extrinsics = read_camera(folder / "parm" / position, vid)
        intrinsics[:2, 2] += self._shift
        # Half of the maximum reads 0/1, 0/255 and compressed masks alike.
        return View(
            image=rgb(image),
            mask=mask > mask.max() / 2,
            inverse_depth=inverse,
            intrinsics=intrinsics.astype(np.float32),
            extrinsics=extrinsics.astype(np.float32),
        )


def _positions(images: Path) -> dict[str, list[int]]:
    """Ring positions of each subject that ``images`` has folders of."""
    found: dict[str, list[int]] = {}
    for entry in images.iterdir() if images.is_dir() else ():
        if match := _POSITION.fullmatch(entry.name):
            found.setdefault(match[1], []).append(int(match[2]))
    return found
