"""THuman2.0: raw scans (:mod:`ghgs_lit.synthesis.thuman2_scans`) and renders of them.

The renders lie as :mod:`ghgs_lit.data.layout` describes; what GPS-Gaussian, GHG, RoGSplat and the authors'
release render is read as it is. GHG keeps its bodies beside the scans (``<source>/<id>/<id>_transform.npy``).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np

from ghgs_lit.data.layout import BodyReader
from ghgs_lit.data.reader import PHASES
from ghgs_lit.data.splits import read_split
from ghgs_lit.synthesis.datasets import Scans
from ghgs_lit.synthesis.thuman2_scans import THuman2Source, find_fits, ghg_body


@dataclass(frozen=True, kw_only=True)
class THuman2(Scans):
    """THuman2.0, raw and rendered.

    ``split`` (:func:`read_split`) also selects among the renders at ``root``; null: its folders ``train`` and
    ``val``.

    Attributes:
        fits: folder of the SMPL-X fits (null: found by its usual names in or beside ``source``).
        body_model: folder of the licensed SMPL-X model (null: the fits' own meshes are read).
    """

    published: ClassVar[Mapping[str, int]] = {"train": 426, "val": 100}

    fits: str | None = None
    body_model: str | None = None

    def scans(self) -> THuman2Source:
        folder = self.source_folder
        model = Path(self.body_model).expanduser() if self.body_model else None
        return THuman2Source(folder, find_fits(folder, self.fits), model)

    def subject_names(self, phase: str) -> list[str] | None:
        if self.split is None:
            return None
        images = [self.folder / p / "img" for p in PHASES]
        there = {e.name.rpartition("_")[0] for folder in images if folder.is_dir() for e in folder.iterdir()}
        return read_split(self.split, sorted(there))[phase]

    def further_bodies(self) -> BodyReader | None:
        return None if self.source is None else partial(_body_beside_scan, self.scans())

    def inspections(self) -> list[Callable[[], None]]:
        """Every raw scan with its fit, if ``source`` is given."""
        if self.source is None:
            return []
        source = self.scans()
        return [partial(source.check, name) for name in source.names()]


def _body_beside_scan(source: THuman2Source, name: str) -> np.ndarray | None:
    """The body [n, 3] of a scan that GHG rendered, in the world of its renders; None for other scans."""
    transform = source.folder / name / f"{name}_transform.npy"
    fit = source.body(name) if transform.exists() else None
    return None if fit is None else ghg_body(transform, fit).astype(np.float32)
