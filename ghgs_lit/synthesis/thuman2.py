"""THuman2.0: raw scans with SMPL-X fits as released, and renders.

::

    <source>/<id>/<id>.obj, material0.jpeg, material0.mtl     526 scans 0000 ... 0525, y up, no metric units
    <fits>/<id>/smplx_param.pkl, mesh_smplx.obj               the fit, in the frame of its scan

Renders have the layout of :mod:`ghgs_lit.data.layout`; those of GPS-Gaussian, GHG, RoGSplat and the authors'
release can be read unchanged. GHG stores how it moved bodies in ``<source>/<id>/<id>_transform.npy``."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from ghgs_lit.config import options
from ghgs_lit.config.options import Share, Size, Text, Workers
from ghgs_lit.data.decoding import check_array
from ghgs_lit.data.layout import BodyReader
from ghgs_lit.data.pickles import load_npy, load_pickle
from ghgs_lit.errors import InputError, installed
from ghgs_lit.synthesis.datasets import Scans
from ghgs_lit.synthesis.jobs import RenderOptions
from ghgs_lit.synthesis.people.mesh import Person
from ghgs_lit.synthesis.scans import ScanSource

# Names of the folder of fits in published archives and scripts.
FIT_FOLDERS = ("THuman2.0_smplx", "THuman2.0_Smpl_X_Paras", "THuman2.0_SMPLX_Paras", "smplx_2", "smplx")
_NEEDED = ("betas", "global_orient", "body_pose")
_MORE = ("left_hand_pose", "right_hand_pose", "jaw_pose", "leye_pose", "reye_pose", "expression")
_FIT_SIZES = {"global_orient": (3,), "scale": (1,), "translation": (3,), "transl": (3,)}


@dataclass(frozen=True)
class SmplxFit:
    """The content of ``smplx_param.pkl``. ``parameters``: of the male SMPL-X model, by name, [1, n].
    ``scale``, ``translation``: from the model's frame to the scan's, ``v * scale + translation``."""

    parameters: Mapping[str, np.ndarray]
    scale: float
    translation: np.ndarray

    def to_scan(self, vertices: np.ndarray) -> np.ndarray:
        """Vertices [n, 3] of the model in the scan's frame."""
        return vertices * self.scale + self.translation

    @property
    def facing(self) -> float:
        """Angle about y from +z to the direction that the body faces, in degrees."""
        forward = Rotation.from_rotvec(self.parameters["global_orient"][0]).as_matrix()[:, 2]
        return float(np.degrees(np.arctan2(forward[0], forward[2])))


def read_fit(path: Path) -> SmplxFit:
    """The fit at ``path``; its pickle is read without executing it. InputError: it is missing, no plain
    pickle, lacks a key, or a value has another shape or is not finite."""
    content = load_pickle(path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected a dictionary; found {type(content).__name__}")
    # Fits of SMPL made for the same scans call it transl.
    moved = "transl" if "transl" in content else "translation"
    for name in (*_NEEDED, "scale", moved):
        if name not in content:
            raise InputError(f"{path}: expected the key {name!r}; found {sorted(map(str, content))}")
    values = {
        name: check_array(f"{path}: {name}", np.ravel(content[name]), [_FIT_SIZES.get(name, (None,))])
        for name in (*_NEEDED, "scale", moved, *(n for n in _MORE if n in content))
    }
    scale, translation = values.pop("scale"), values.pop(moved)
    if scale[0] <= 0:
        raise InputError(f"{path}: scale: expected more than 0; found {scale[0]}")
    return SmplxFit({name: value[None] for name, value in values.items()}, float(scale[0]), translation)


def find_fits(source: Path, fits: str | None) -> Path | None:
    """The folder of the fits; None if there is none. ``fits``: the configured folder (None: one of
    :data:`FIT_FOLDERS` in or beside ``source``). InputError: the configured folder does not exist."""
    if fits is not None:
        folder = Path(fits).expanduser()
        if not folder.is_dir():
            raise InputError(f"{folder}: expected the folder of the SMPL-X fits; found no such folder")
        return folder
    candidates = [place / name for place in (source, source.parent) for name in FIT_FOLDERS]
    return next((folder for folder in candidates if folder.is_dir()), None)


@dataclass(frozen=True)
class THuman2Source:
    """Raw scans with their bodies. ``fits``: folder of the fits (None: each scan's own folder).
    ``body_model``: folder of the licensed SMPL-X model files (package ``smplx``), to compute bodies from
    ``smplx_param.pkl`` (None: read the fits' ``mesh_smplx.obj``)."""

    folder: Path
    fits: Path | None
    body_model: Path | None = None

    def names(self) -> list[str]:
        return ScanSource(self.folder).names()

    def fit(self, name: str) -> Path | None:
        """The folder of a scan's fit; None without :attr:`fits`. InputError: they have none of this scan."""
        if (self.folder / name / "smplx_param.pkl").exists():
            return self.folder / name
        if self.fits is None:
            return None
        if not (self.fits / name).is_dir():
            raise InputError(f"{self.fits / name}: expected the scan's SMPL-X fit; found no such folder")
        return self.fits / name

    def body(self, name: str) -> np.ndarray | None:
        """Body vertices [n, 3] float64 in the scan's frame; None without fits. InputError: the fit is bad, or
        its vertices are not stored and cannot be computed."""
        folder = self.fit(name)
        if folder is None:
            return None
        parameters, mesh = folder / "smplx_param.pkl", folder / "mesh_smplx.obj"
        if self.body_model is not None:
            fit = read_fit(parameters)
            return fit.to_scan(smplx_vertices(self.body_model, fit.parameters))
        if not mesh.exists():
            raise InputError(
                f"{mesh}: expected the fitted mesh, or data.body_model with the licensed SMPL-X model to "
                "compute it; found neither"
            )
        return _obj_vertices(mesh)

    def load(self, name: str) -> Person:
        """A scan with its body, as stored. InputError: the scan or fit is bad, or the body lies outside."""
        scan, body = ScanSource(self.folder).load(name), self.body(name)
        if body is None:
            return scan
        _check_body(self.fit(name), scan, body)
        return Person(name, scan.parts, body.astype(np.float32))

    def check(self, name: str) -> None:
        """Read all files that rendering a scan needs. InputError: one of them is bad."""
        self.load(name)
        self.facing(name)

    def facing(self, name: str) -> float:
        """Degrees by which the first camera is turned about y to face the person; 0 without a fit."""
        folder = self.fit(name)
        path = None if folder is None else folder / "smplx_param.pkl"
        return 0.0 if path is None or not path.exists() else read_fit(path).facing


def _obj_vertices(path: Path) -> np.ndarray:
    try:
        with path.open() as lines:
            vertices = [line.split()[1:4] for line in lines if line.startswith("v ")]
        return check_array(path, np.array(vertices, np.float64), [(None, 3)])
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: expected lines 'v x y z'; found {error}") from error


def _check_body(folder: Path, scan: Person, body: np.ndarray) -> None:
    """Refuse a body outside its scan, as when scale or translation were not applied."""
    points = np.concatenate([part.vertices for part in scan.parts])
    low, high = points.min(0), points.max(0)
    tall = high[1] - low[1]
    outside = np.maximum(np.maximum(low - body.min(0), body.max(0) - high), 0).max()
    ratio = np.ptp(body[:, 1]) / tall
    if outside > 0.1 * tall or not 0.7 < ratio < 1.2:
        raise InputError(
            f"{folder}: expected a body in its scan's frame; found one {ratio:.2f} times as tall as the scan "
            f"that leaves its box by {outside / tall:.2f} of its height (scale before translation?)"
        )


@lru_cache(maxsize=2)
def _smplx_model(folder: Path) -> Any:
    smplx = installed("smplx", "smpl", "data.body_model")
    if not folder.exists():
        raise InputError(f"{folder}: expected the SMPL-X model (data.body_model); found no such folder")
    try:
        return smplx.create(str(folder), "smplx", gender="male", num_pca_comps=12, use_pca=True, num_betas=10)
    except (AssertionError, OSError, ValueError) as error:
        raise InputError(f"{folder}: expected smplx/SMPLX_MALE.npz; found {error}") from error


def smplx_vertices(folder: Path, parameters: Mapping[str, np.ndarray]) -> np.ndarray:
    """Vertices [10475, 3] of the male SMPL-X model, before scale and translation. ``parameters``: by name,
    [1, n]. InputError: the package or the model files are missing."""
    import torch

    model = _smplx_model(folder)
    with torch.no_grad():
        posed = model(**{name: torch.from_numpy(value).float() for name, value in parameters.items()})
    return posed.vertices[0].double().numpy()


def ghg_body(path: Path, vertices: np.ndarray) -> np.ndarray:
    """Move body ``vertices`` [n, 3] as GHG's renderer moved the scan. InputError: no file, or no number."""
    content = load_npy(path)
    names = ("vy_max", "vy_min", "human_height", "offset", "move_delta_axis_0", "move_delta_axis_2")
    for name in names:
        if not isinstance(content, dict) or name not in content:
            raise InputError(f"{path}: expected a dictionary with {name!r}; found none")
    high, low, tall, offset, x, z = (float(check_array(path, np.ravel(content[n]), [(1,)])[0]) for n in names)
    return vertices * (tall / (high - low)) + np.array([x, -offset, z])


class THuman2(Scans):
    """THuman2.0, raw and rendered."""

    published: ClassVar[Mapping[str, int]] = {"train": 426, "val": 100}

    name: Text = "thuman2"
    size: Size = (512, 512)
    workers: Workers = 8
    render: RenderOptions = RenderOptions(size=1024, samples=2, views=(0, 1, 2, 3, 4), quality=95)
    val_fraction: Share = 0.19
    pixel_centers: Literal["half", "integer", "auto"] = "auto"
    fits: options.Path | None = None
    """Folder with <id>/smplx_param.pkl, mesh_smplx.obj; null: by its usual names in or beside source."""
    body_model: options.Path | None = None
    """Folder of the licensed SMPL-X model; null: the fits' mesh_smplx.obj."""

    def scans(self) -> THuman2Source:
        folder = self.source_folder
        model = Path(self.body_model).expanduser() if self.body_model else None
        return THuman2Source(folder, find_fits(folder, self.fits), model)

    def further_bodies(self) -> BodyReader | None:
        return None if self.source is None else partial(_body_beside_scan, self.scans())

    def inspections(self) -> list[Callable[[], None]]:
        """Checks of every raw scan with its fit, if ``source`` is given."""
        if self.source is None:
            return []
        source = self.scans()
        return [partial(source.check, name) for name in source.names()]


def _body_beside_scan(source: THuman2Source, name: str) -> np.ndarray | None:
    """The body [n, 3] of a scan rendered by GHG, in the world of its renders; None for other scans."""
    transform = source.folder / name / f"{name}_transform.npy"
    fit = source.body(name) if transform.exists() else None
    return None if fit is None else ghg_body(transform, fit).astype(np.float32)
