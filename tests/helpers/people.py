"""Tiny people for tests: coloured boxes, as meshes, as scans on disk and as a rendered data set."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
import trimesh
from PIL import Image

from ghgs_people.datasets import Scans
from ghgs_people.figures.mesh import Person, TexturedMesh
from ghgs_people.jobs import RenderOptions, render_people
from ghgs_people.rig import Rig
from ghgs_people.scans import ScanSource

if TYPE_CHECKING:  # rendering processes do not import Lightning
    from ghgs_lit.data.datamodule import PhotographsDataModule

V4 = {"training_counts": [4], "evaluation_count": 4}
RELEASE = {"name": "release", "training_views": [2, 3, 4]}
RIG = Rig()
TINY = RenderOptions(size=42, samples=2)


def rendered(
    root: Path, views=V4, targets=RELEASE, seed=0, augmentation=None, **options
) -> PhotographsDataModule:
    """The data module of people that :func:`render_boxes` has rendered."""
    return Scans(root=root, **{"size": 28, "render": TINY, **options}).build(
        views, targets, seed, augmentation
    )


def box_person(name: str = "box", color=(200, 90, 30), extents=(0.5, 1.7, 0.3)) -> Person:
    mesh = trimesh.creation.box(extents)
    vertices = np.asarray(mesh.vertices, np.float32)
    texture = np.tile(np.array(color, np.uint8), (4, 4, 1))
    uv = np.full((len(vertices), 2), 0.5, np.float32)
    part = TexturedMesh(vertices, np.asarray(mesh.faces, np.int64), uv, texture)
    return Person(name, (part,), vertices.copy())


def write_obj_scan(folder: Path, name: str, color=(200, 90, 30)) -> Path:
    """Write a scan in the format of THuman2.0, with all vertices as body vertices."""
    person = box_person(name, color, (0.4 + 0.01 * len(name), 1.5, 0.3))
    part = person.parts[0]
    (folder / name).mkdir(parents=True)
    lines = ["mtllib material0.mtl", "usemtl material0"]
    lines += [f"v {x} {y} {z}" for x, y, z in part.vertices + np.float32([1, 2, 3])]
    lines += [f"vt {u} {v}" for u, v in part.uv]
    lines += ["f " + " ".join(f"{i + 1}/{i + 1}" for i in face) for face in part.faces]
    path = folder / name / f"{name}.obj"
    path.write_text("\n".join(lines))
    (folder / name / "material0.mtl").write_text("newmtl material0\nmap_Kd material0.jpeg\n")
    Image.fromarray(part.texture).save(folder / name / "material0.jpeg", quality=100, subsampling=0)
    np.save(folder / name / "body_vertices.npy", (part.vertices + np.float32([1, 2, 3])).astype(np.float16))
    return path


def render_boxes(root: Path, folder: Path, train: int = 3, val: int = 2, **changes) -> ScanSource:
    """Render scans ``s0`` ... below ``root``; the scans are in ``folder``."""
    names = [f"s{i}" for i in range(train + val)]
    for i, name in enumerate(names):
        if not (folder / name).exists():
            write_obj_scan(folder, name, color=(40 * i + 40, 90, 200 - 40 * i))
    source = ScanSource(folder)
    arguments = {"rig": RIG, "settings": TINY, "seed": 0, "workers": 0} | changes
    render_people(root, {"train": names[:train], "val": names[train:]}, source, **arguments)
    return source


def equal(a, b) -> bool:
    """Whether two batches agree in every tensor and name."""
    for field in dataclasses.fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, torch.Tensor):
            if not torch.equal(x, y):
                return False
        elif dataclasses.is_dataclass(x):
            if not equal(x, y):
                return False
        elif isinstance(x, list):
            if not all(torch.equal(p, q) for p, q in zip(x, y, strict=True)):
                return False
        elif x != y:
            return False
    return True
