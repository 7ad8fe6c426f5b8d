"""Textured meshes as people have them: THuman2.0 scans (``.obj``) and multi-part ``.glb`` files."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from ghgs_lit.data.reader import read_array, read_image
from ghgs_lit.errors import InputError, require
from ghgs_lit.synthesis.people.mesh import Person, TexturedMesh

_MESH_SUFFIXES = (".glb", ".gltf", ".obj")
_IMAGE_SUFFIXES = (".jpeg", ".jpg", ".png")
_SPLIT_FILES = ("splits.json", "split_train.txt")


@dataclass(frozen=True)
class ScanSource:
    """A folder ``<folder>/<id>/<id>.obj`` (with its ``material0.jpeg``) or ``<folder>/<id>/<id>.glb``."""

    folder: Path

    def names(self) -> list[str]:
        """Ids of all scans, sorted.

        Raises:
            InputError: the folder is missing or holds no scans.
        """
        if not self.folder.is_dir():
            raise InputError(f"{self.folder}: expected a folder of scans; found no such folder")
        names = sorted(p.name for p in self.folder.iterdir() if p.is_dir() and _mesh_file(p) is not None)
        if not names:
            raise InputError(f"{self.folder}: expected <id>/<id>.obj or <id>/<id>.glb; found none")
        return names

    def load(self, name: str) -> Person:
        """One scan with its ``body_vertices.npy``, where it has one, as stored.

        Raises:
            InputError: no mesh, an unreadable one, or a part without texture.
        """
        folder = self.folder / name
        path = _mesh_file(folder) if folder.is_dir() else None
        if path is None:
            raise InputError(f"{folder}: expected {name}.obj or {name}.glb; found neither")
        body_path = folder / "body_vertices.npy"
        body = read_array(body_path, [(None, 3)]).astype(np.float32) if body_path.exists() else None
        return Person(name=name, parts=load_parts(path), body_vertices=body)

    def facing(self, name: str) -> float:
        """Degrees about y that the first camera is turned by: nothing is known of these scans."""
        return 0.0


def _mesh_file(folder: Path) -> Path | None:
    return next((p for s in _MESH_SUFFIXES if (p := folder / f"{folder.name}{s}").is_file()), None)


def load_parts(path: Path) -> tuple[TexturedMesh, ...]:
    """All textured meshes of a file, in its world frame."""
    try:
        scene = trimesh.load_scene(path, process=False)
    except Exception as error:  # trimesh raises whatever its parsers raise
        raise InputError(f"{path}: expected a readable mesh; found {error!r}") from error
    parts = []
    for node in sorted(scene.graph.nodes_geometry):
        transform, geometry = scene.graph[node]
        mesh = scene.geometry[geometry]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            parts.append(_part(path, geometry, mesh, transform))
    if not parts:
        raise InputError(f"{path}: expected triangles; found none")
    return tuple(parts)


def _part(path: Path, name: str, mesh: trimesh.Trimesh, transform: np.ndarray) -> TexturedMesh:
    material = getattr(mesh.visual, "material", None)
    uv = getattr(mesh.visual, "uv", None)
    texture, cutoff = _texture(path, material)
    if texture is None:
        raise InputError(f"{path}: expected a texture for the mesh {name!r}; found none")
    if texture.shape[:2] == (1, 1) and uv is None:
        uv = np.zeros((len(mesh.vertices), 2))
    if uv is None or len(uv) != len(mesh.vertices):
        raise InputError(f"{path}: expected texture coordinates for the mesh {name!r}; found none")
    return TexturedMesh(
        vertices=trimesh.transform_points(mesh.vertices, transform).astype(np.float32),
        faces=np.asarray(mesh.faces, np.int64),
        uv=np.asarray(uv, np.float32),
        texture=texture,
        alpha_cutoff=cutoff,
    )


def _texture(path: Path, material: object) -> tuple[np.ndarray | None, float | None]:
    """Texture [h, w, 3 or 4] uint8 and alpha cutoff of a material; None where it has no colour."""
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is not None and image.format is None:  # not from a file: trimesh's stand-in for a lost material
        image = None
    factor = getattr(material, "baseColorFactor", None)
    if image is None and factor is not None:  # one plain colour, as buttons and eyes often have
        return np.asarray(factor, np.uint8).reshape(1, 1, -1)[..., :3], None
    if image is None and path.suffix == ".obj":
        image = _image_beside(path)
    if image is None:
        return None, None
    mode = str(getattr(material, "alphaMode", None) or "OPAQUE").upper()
    # Blended hair is cut at one half: a photograph here has one surface a ray.
    cutoff = None if mode == "OPAQUE" else float(getattr(material, "alphaCutoff", None) or 0.5)
    has_alpha = "A" in image.getbands() or "transparency" in image.info
    cutoff = cutoff if has_alpha else None
    texture = np.asarray(image.convert("RGB" if cutoff is None else "RGBA"))
    if factor is not None:
        scale = np.asarray(factor, np.float64)[: texture.shape[2]] / 255
        texture = np.round(texture * scale).astype(np.uint8)
    return texture, cutoff


def _image_beside(path: Path) -> Image.Image | None:
    """The texture of a scan whose ``.mtl`` was lost: ``material0.*``, or the only image there is."""
    images = sorted(p for p in path.parent.iterdir() if p.suffix.lower() in _IMAGE_SUFFIXES)
    named = [p for p in images if p.stem == "material0"]
    chosen = named[:1] or (images if len(images) == 1 else [])
    return read_image(chosen[0]) if chosen else None


def split_names(
    source: Path,
    names: Sequence[str],
    split: str | Mapping[str, Sequence[str]] | None,
    val_fraction: float,
    seed: int,
) -> dict[str, list[str]]:
    """Which of ``names`` are ``train`` and which ``val``.

    ``split`` is as for :func:`read_split`. Without it, such files in the source folder count; without
    those, ``val_fraction`` of the names are drawn by ``seed``.

    Raises:
        InputError: the split is missing or malformed, names scans that do not exist, or overlaps.
    """
    if split is None and not any((source / name).exists() for name in _SPLIT_FILES):
        require(0 <= val_fraction < 1, "data.val_fraction", "at least 0 and below 1", val_fraction)
        order = np.random.default_rng(seed).permutation(len(names))
        count = round(val_fraction * len(names))
        return {
            "train": [names[i] for i in sorted(order[count:])],
            "val": [names[i] for i in sorted(order[:count])],
        }
    chosen = read_split(source if split is None else split, names)
    for phase, listed in chosen.items():
        if unknown := sorted(set(listed) - set(names)):
            raise InputError(
                f"{split or source}: expected ids of scans in {source}; found {unknown[0]!r} in {phase}"
            )
    return chosen


def read_split(split: str | Path | Mapping[str, Sequence[str]], names: Sequence[str]) -> dict[str, list[str]]:
    """Who is ``train`` and who ``val`` (a split without ``val`` may call it ``test``).

    ``split``: a JSON file with these lists, a folder with one or with ``split_train.txt`` and
    ``split_val.txt`` (one id a line), or a mapping of ids and of ranges ``0000-0425``, which stand for
    those of ``names`` that lie in them.

    Raises:
        InputError: it is missing, malformed, or somebody is in both.
    """
    if isinstance(split, Mapping):
        place: Path | str = "data.split"
        chosen = _lists(place, split)
        chosen = {
            phase: [n for entry in listed for n in _expand(entry, names)] for phase, listed in chosen.items()
        }
    else:
        folder = place = Path(split).expanduser()
        if folder.is_dir():
            place = next((p for n in _SPLIT_FILES if (p := folder / n).exists()), folder)
        if not place.is_file():
            raise InputError(f"{place}: expected a JSON file or a folder with split_train.txt; found neither")
        chosen = _read_split(place)
    if both := sorted(set(chosen["train"]) & set(chosen["val"])):
        raise InputError(f"{place}: expected disjoint train and val; found {both[0]!r} in both")
    return chosen


def _expand(entry: object, names: Sequence[str]) -> list[str]:
    """An id, or those of ``names`` in a range of ids of equal length."""
    first, dash, last = str(entry).partition("-")
    if not dash:
        return [str(entry)]
    return [name for name in names if len(name) == len(first) and first <= name <= last]


def _lists(place: Path | str, content: Mapping) -> dict[str, list]:
    chosen = {"train": content.get("train"), "val": content.get("val", content.get("test"))}
    for phase, listed in chosen.items():
        if not isinstance(listed, Sequence) or isinstance(listed, str):
            raise InputError(f"{place}: expected a list {phase!r} (test does for val); found {listed!r}")
    return {phase: list(listed) for phase, listed in chosen.items()}


def _read_split(path: Path) -> dict[str, list[str]]:
    if path.suffix == ".json":
        try:
            content = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: expected JSON; found {error}") from error
        return _lists(path, content if isinstance(content, Mapping) else {})
    result = {}
    for phase in ("train", "val"):
        file = path.with_name(f"split_{phase}.txt")
        if not file.exists():
            raise InputError(f"{file}: expected one id a line; found no such file")
        result[phase] = file.read_text().split()
    return result
