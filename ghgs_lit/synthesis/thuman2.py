"""THuman2.0: raw scans (:mod:`ghgs_lit.synthesis.thuman2_scans`) and renders of them.

The renders lie as :mod:`ghgs_lit.data.layout` describes; what GPS-Gaussian, GHG, RoGSplat and the authors'
release render is read as it is. GHG keeps its bodies beside the scans (``<source>/<id>/<id>_transform.npy``).
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np

from ghgs_lit.config import options
from ghgs_lit.config.options import Share, Size, Text, Workers
from ghgs_lit.data.layout import BodyReader
from ghgs_lit.synthesis.datasets import Scans
from ghgs_lit.synthesis.jobs import RenderOptions
from ghgs_lit.synthesis.thuman2_scans import THuman2Source, find_fits, ghg_body


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
