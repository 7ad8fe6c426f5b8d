"""THuman2.0: raw scans with SMPL-X fits as released, and their renderings.

::

    <source>/<id>/<id>.obj, material0.jpeg, material0.mtl     526 scans 0000 ... 0525, y up, no metric units
    <fits>/<id>/smplx_param.pkl, mesh_smplx.obj               the fit, in the frame of its scan

Renderings have the layout of :mod:`ghgs_lit.data.layout`; those of GPS-Gaussian, GHG, RoGSplat and the
authors' release can be read without conversion."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from ghgs_lit.config import options
from ghgs_lit.config.options import Size, Text
from ghgs_lit.data.decoding import check_array
from ghgs_lit.data.pickles import load_pickle
from ghgs_lit.errors import InputError
from ghgs_lit.parsing import find_path, read_text, require_folder
from ghgs_people.datasets import Scans
from ghgs_people.figures.mesh import Person
from ghgs_people.jobs import RenderOptions
from ghgs_people.scans import ScanSource

# Names of the folder of fits in published archives and scripts
FIT_FOLDERS = ("THuman2.0_smplx", "THuman2.0_Smpl_X_Paras", "THuman2.0_SMPLX_Paras", "smplx_2", "smplx")


def find_fits(source: Path, fits: str | None) -> Path | None:
    """Find the folder of the SMPL-X fits.

    Args:
        source: folder of the scans.
        fits: configured folder; None: one of :data:`FIT_FOLDERS` in or next to ``source``.

    Returns:
        The folder, or None.

    Raises:
        InputError: the configured folder does not exist.
    """
    if fits is not None:
        folder = Path(fits).expanduser()
        require_folder(folder, "the folder of the SMPL-X fits")
        return folder
    for place in (source, source.parent):
        for name in FIT_FOLDERS:
            if (place / name).is_dir():
                return place / name
    return None


@dataclass(frozen=True)
class THuman2Source(ScanSource):
    """Raw scans with their SMPL-X bodies.

    Args:
        folder: folder of the scans.
        fits: folder of the fits; None: scans without bodies.
    """

    fits: Path | None = None

    def load(self, name: str) -> Person:
        """Read a scan with its body, as stored.

        Args:
            name: id of the scan.

        Returns:
            The scan, in its own unit, with the vertices [n, 3] of its fit.

        Raises:
            InputError: the scan or fit is invalid, or the body lies outside of the scan.
        """
        scan = super().load(name)
        if self.fits is None:
            return scan
        path = self._fit(name, "mesh_smplx.obj")
        lines = read_text(path, "the fitted mesh").splitlines()
        body = check_array(path, [line.split()[1:4] for line in lines if line.startswith("v ")], [(None, 3)])
        _check_body(path.parent, scan, body)
        return replace(scan, body_vertices=body.astype(np.float32))

    def facing(self, name: str) -> float:
        """Direction that a scan faces, from the root rotation of its fit (``global_orient`` of SMPL-X).

        The fit's pickle is read without executing code in it.

        Args:
            name: id of the scan.

        Returns:
            Degrees by which the first camera is turned about y to face the person, -180 to 180; 0
            without a fit.

        Raises:
            InputError: the fit is missing or invalid.
        """
        if self.fits is None:
            return 0.0
        path = self._fit(name, "smplx_param.pkl")
        content = load_pickle(path)
        if not isinstance(content, dict) or "global_orient" not in content:
            found = sorted(map(str, content)) if isinstance(content, dict) else type(content).__name__
            raise InputError(f"{path}: expected the key 'global_orient'; found {found}")
        turn = check_array(f"{path}: global_orient", np.ravel(content["global_orient"]), [(3,)])
        forward = Rotation.from_rotvec(turn).as_matrix()[:, 2]
        return float(np.degrees(np.arctan2(forward[0], forward[2])))

    def _fit(self, name: str, file: str) -> Path:
        """Path of a file of a scan's fit, found regardless of case."""
        folder = find_path(self.fits, name) or self.fits / name
        require_folder(folder, "the scan's SMPL-X fit")
        return find_path(folder, file) or folder / file


def _check_body(folder: Path, scan: Person, body: np.ndarray) -> None:
    """Reject a body that exceeds its scan's box by more than 0.1 of its height, or is not 0.7 to 1.2 times as
    tall, as happens if scale or translation are not applied."""
    points = np.concatenate([part.vertices for part in scan.parts])
    low = points.min(0)
    high = points.max(0)
    tall = high[1] - low[1]
    outside = np.maximum(np.maximum(low - body.min(0), body.max(0) - high), 0).max()
    ratio = np.ptp(body[:, 1]) / tall
    if outside > 0.1 * tall or not 0.7 < ratio < 1.2:
        raise InputError(
            f"{folder}: expected a body in its scan's frame; found one {ratio:.2f} times as tall as the scan "
            f"that leaves its box by {outside / tall:.2f} of its height (scale before translation?)"
        )


class THuman2(Scans):
    """THuman2.0, raw and rendered."""

    val_fraction: ClassVar[float] = 0.19

    name: Text = "thuman2"
    size: Size = 512
    render: RenderOptions = RenderOptions(
        size=1024, samples=2, views=(0, 1, 2, 3, 4), quality=95, lights="none"
    )
    pixel_centers: Literal["half", "integer", "auto"] = "auto"
    fits: options.PathText | None = None
    """Folder of <id>/smplx_param.pkl and mesh_smplx.obj; null: found by its usual names in or next to
    source."""

    def scans(self) -> THuman2Source:
        return THuman2Source(self.source_folder, find_fits(self.source_folder, self.fits))
