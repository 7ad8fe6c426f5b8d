"""THuman2.0: raw scans (:mod:`ghgs_lit.synthesis.thuman2_scans`) and renders of them.

The renders lie as :mod:`ghgs_lit.data.layout` says; what GPS-Gaussian, GHG, RoGSplat and the authors'
release render is read as it is. GHG keeps its bodies beside the scans (``<source>/<id>/<id>_transform.npy``).
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ghgs_lit.data.layout import Layout
from ghgs_lit.errors import InputError
from ghgs_lit.synthesis.datamodules import ScansDataModule
from ghgs_lit.synthesis.scans import read_split
from ghgs_lit.synthesis.thuman2_scans import THuman2Source, find_fits, ghg_body


class THuman2Layout(Layout):
    """Renders of THuman2.0; bodies that are not among them are looked for beside the raw scans."""

    def __init__(self, *args: Any, source: THuman2Source | None = None, **options: Any) -> None:
        self.source = source
        super().__init__(*args, **options)

    def read_body(self, name: str) -> np.ndarray | None:
        body = super().read_body(name)
        if body is not None or self.source is None:
            return body
        transform = self.source.folder / name / f"{name}_transform.npy"
        fit = self.source.body(name) if transform.exists() else None
        return None if fit is None else ghg_body(transform, fit).astype(np.float32)


class THuman2DataModule(ScansDataModule):
    """THuman2.0, raw and rendered.

    Args:
        fits: folder of the SMPL-X fits (null: found by its usual names in or beside ``source``).
        body_model: folder of the licensed SMPL-X model (null: the fits' own meshes are read).
        split: who is train and who val: a folder with ``split_train.txt`` and ``split_val.txt``, a JSON file,
            or ``{train: [ids and ranges], val: ...}``. Null: the folders ``train`` and ``val`` of what is
            rendered; for rendering, the split files in ``source``, else a fraction.
        other: as for :class:`ScansDataModule`.
    """

    published: ClassVar[Mapping[str, int]] = {"train": 426, "val": 100}

    def __init__(
        self,
        *args: Any,
        fits: str | None = None,
        body_model: str | None = None,
        split: str | Mapping[str, Sequence[str]] | None = None,
        **other: Any,
    ) -> None:
        super().__init__(*args, split=split, **other)
        self.fits = fits
        self.body_model = Path(body_model).expanduser() if body_model else None

    def scans(self) -> THuman2Source:
        folder = self.source_folder
        return THuman2Source(folder, find_fits(folder, self.fits), self.body_model)

    def subject_names(self, phase: str) -> list[str] | None:
        if self.split is None:
            return None
        images = [self.folder / p / "img" for p in ("train", "val")]
        there = {e.name.rpartition("_")[0] for folder in images if folder.is_dir() for e in folder.iterdir()}
        return read_split(self.split, sorted(there))[phase]

    def reader(self, phase: str, size: tuple[int, int] | None, strict: bool = True) -> THuman2Layout:
        source = None if self.source is None else self.scans()
        return THuman2Layout(
            self.folder, phase, size, source=source, **self.layout_options(phase), strict=strict
        )

    def inspections(self) -> list[Callable[[], None]]:
        """Every raw scan with its fit, where ``source`` is given."""
        if self.source is None:
            return []
        source = self.scans()
        return [partial(source.check, name) for name in source.names()]

    def miniature(self, people: Mapping[str, int], size: int, seed: int) -> list[Path]:
        """Raw scans in ``source`` where it is given, else renders in ``root``, as published scripts make."""
        from ghgs_lit.synthesis.miniatures import thuman2

        written = []
        if self.source is not None:
            written.append(thuman2.make_raw(Path(self.source).expanduser(), people, size, seed))
        if self.root is not None and self.source is None:
            written.append(thuman2.make(Path(self.root).expanduser(), people, size, seed))
        if not written:
            raise InputError("data.root: expected a folder for renders, or data.source for scans; found none")
        return written
