"""Read scans: textured meshes as ``.obj`` (like those of THuman2.0) or ``.glb`` with several parts."""

import io
import json
import logging
import re
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import trimesh
from PIL import Image

from ghgs_lit.data.decoding import check_extent, limit_formats, read_image, read_vertices
from ghgs_lit.errors import InputError, require
from ghgs_lit.parsing import find_path, require_folder, split_path
from ghgs_people.figures.mesh import Person, TexturedMesh

log = logging.getLogger(__name__)

_MESH_SUFFIXES = (".glb", ".gltf", ".obj")
#: Options of map_Kd that move, scale or clamp an image, except those without effect
_MOVES = r"(-\w+ \S+ )*-(s(?! 1(\.0*)? 1(\.0*)? )|o(?! 0(\.0*)? 0(\.0*)? )|t|clamp on) "
#: Required extensions of a file that can be ignored
_READ_EXTENSIONS = ("EXT_texture_webp", "KHR_lights_punctual", "KHR_materials_")
_FLOAT = 5126  #: glTF component type that trimesh can read for texture coordinates
_IMAGE_SUFFIXES = (".jpeg", ".jpg", ".png")


@dataclass(frozen=True)
class ScanSource:
    """Folder of scans ``<id>/<id>.obj`` (with ``material0.jpeg``) or ``<id>/<id>.glb``."""

    folder: Path

    def names(self) -> list[str]:
        """List the sorted ids of scans; folders whose meshes have other names are logged.

        Raises:
            InputError: the folder is missing or contains no scans.
        """
        require_folder(self.folder, "a folder of scans")
        folders = [p for p in self.folder.iterdir() if p.is_dir() and not p.name.startswith(".")]
        names = sorted(p.name for p in folders if _mesh_file(p) is not None)
        others = sorted(p.name for p in folders if p.name not in names and _has_meshes(p))
        if others:
            example = f"{others[0]}/{others[0]}.obj"
            log.warning(
                "%s: no scans, since their meshes are not named as %s: %s",
                self.folder,
                example,
                ", ".join(others),
            )
        if not names:
            raise InputError(f"{self.folder}: expected <id>/<id>.obj or <id>/<id>.glb; found none")
        return names

    def load(self, name: str) -> Person:
        """Read a scan as stored, with its ``body_vertices.npy`` if there is one.

        Args:
            name: id of the scan.

        Raises:
            InputError: the mesh is missing or unreadable, or a part has no texture.
        """
        folder = self.folder / name
        path = _mesh_file(folder) if folder.is_dir() else None
        if path is None:
            raise InputError(f"{folder}: expected {name}.obj or {name}.glb; found neither")
        body_path = find_path(folder, "body_vertices.npy")
        body = None if body_path is None else read_vertices(body_path)
        return Person(name=name, parts=load_parts(path), body_vertices=body)

    def facing(self, name: str) -> float:
        """0 degrees, since the direction that these scans face is unknown."""
        return 0.0


def _mesh_file(folder: Path) -> Path | None:
    path = find_path(folder, folder.name, _MESH_SUFFIXES)
    return path if path is not None and path.is_file() else None


def _has_meshes(folder: Path) -> bool:
    return any(path.suffix.lower() in (*_MESH_SUFFIXES, ".ply", ".fbx", ".stl") for path in folder.iterdir())


class _Beside(trimesh.resolvers.FilePathResolver):
    """Resolver of the files that a mesh refers to (MTL, textures, buffers), in any system's spelling.

    ``moved`` is a texture that the MTL file moves, scales or clamps."""

    moved = ""

    def get(self, key: str) -> bytes:
        """Read a file; one with a path of another machine is searched next to the mesh.

        Args:
            key: name of the file in the mesh.

        Raises:
            FileNotFoundError: there is no such file.
        """
        name = str(key).strip().strip('"')
        self.moved = self.moved or (name if re.match(_MOVES, name) else "")
        folder = Path(self.parent)
        # Names may have URI escapes, folders of another machine, or options of map_Kd in front.
        for spelling in (name, unquote(name), split_path(name)[-1], *name.split()[-1:]):
            path = find_path(folder, spelling) if spelling else None
            if path is not None and path.is_file():
                return path.read_bytes()
        raise FileNotFoundError(name)


def load_parts(path: Path) -> tuple[TexturedMesh, ...]:
    """Read all textured meshes of a file in its world frame.

    Args:
        path: an ``.obj``, ``.glb`` or ``.gltf`` file.

    Raises:
        InputError: the file cannot be read, has no triangles, is rigged or compressed,
            or a mesh lacks texture or coordinates.
    """
    kind = path.suffix.lower()[1:]
    content = path.read_bytes()
    beside = _Beside(str(path))
    try:
        if kind != "obj":
            _check_gltf(path, content)
        with limit_formats():
            scene = trimesh.load_scene(io.BytesIO(content), kind, beside, process=False)
    except InputError:
        raise
    except Exception as error:  # trimesh lets any exception of its parsers through
        raise InputError(f"{path}: expected a readable mesh; found {error!r}") from error
    require(not beside.moved, str(path), "map_Kd without -s, -o, -t and -clamp", beside.moved)
    parts = []
    for node in sorted(scene.graph.nodes_geometry):
        transform, geometry = scene.graph[node]
        mesh = scene.geometry[geometry]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            parts.append(_part(path, geometry, mesh, transform, len(scene.geometry) == 1))
    if not parts:
        raise InputError(f"{path}: expected triangles; found none")
    return tuple(parts)


def _check_gltf(path: Path, content: bytes) -> None:
    """Reject a glTF or GLB file that trimesh would read as another mesh or with other textures."""
    if content[:4] == b"glTF":  # a GLB file begins with a header of 20 bytes and its JSON
        content = content[20 : 20 + int.from_bytes(content[12:16], "little")]
    tree = json.loads(content)
    required = [name for name in tree.get("extensionsRequired", []) if not name.startswith(_READ_EXTENSIONS)]
    expected = "a mesh without extensions (npx @gltf-transform/cli dequantize in.glb out.glb removes"
    require(
        not required, str(path), f"{expected} compression, or export it uncompressed)", ", ".join(required)
    )
    found = [name for name in ("skins", "animations") if tree.get(name)]
    if "KHR_texture_transform" in tree.get("extensionsUsed", []):
        found.append("KHR_texture_transform")
    for mesh in tree.get("meshes", []):
        for primitive in mesh["primitives"]:
            coordinates = primitive["attributes"].get("TEXCOORD_0")
            if primitive.get("targets"):
                found.append("morph targets")
            if coordinates is not None and tree["accessors"][coordinates]["componentType"] != _FLOAT:
                found.append("TEXCOORD_0 of whole numbers")
    for material in tree.get("materials", []):
        texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
        if texture.get("texCoord", 0):
            found.append("texCoord above 0")
    expected = (
        "a mesh at rest with one set of texture coordinates (in Blender: Object > Convert > Mesh, then export"
    )
    require(
        not found, str(path), f"{expected} without animation and skinning)", ", ".join(dict.fromkeys(found))
    )


def _part(
    path: Path, name: str, mesh: trimesh.Trimesh, transform: np.ndarray, is_alone: bool
) -> TexturedMesh:
    """Convert trimesh's mesh to a textured mesh in the file's world frame."""
    texture = _texture(path, getattr(mesh.visual, "material", None), is_alone)
    if texture is None:
        raise InputError(f"{path}: expected a texture for the mesh {name!r}; found none")
    uv = getattr(mesh.visual, "uv", None)
    if texture.shape[:2] == (1, 1) and uv is None:
        uv = np.zeros((len(mesh.vertices), 2))
    if uv is None or len(uv) != len(mesh.vertices):
        raise InputError(f"{path}: expected texture coordinates for the mesh {name!r}; found none")
    vertices = trimesh.transform_points(mesh.vertices, transform)
    check_extent(f"{path}: {name}", vertices)
    arrays = vertices.astype(np.float32), np.asarray(mesh.faces, np.int64), np.asarray(uv, np.float32)
    return TexturedMesh(*arrays, texture)


def _texture(path: Path, material: object, is_alone: bool) -> np.ndarray | None:
    """Texture [h, w, 3] uint8 of a material, or None; the only mesh of an OBJ may use an image next to it."""
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    # without a format: trimesh's substitute for a missing material
    if image is not None and image.format is None:
        image = None
    factor = getattr(material, "baseColorFactor", None)
    if image is None and factor is not None:  # a plain colour, common for buttons and eyes
        return np.asarray(factor, np.uint8).reshape(1, 1, -1)[..., :3]
    if image is None and is_alone and path.suffix.lower() == ".obj":
        image = _image_beside(path)
    if image is None:
        return None
    mode = str(getattr(material, "alphaMode", None) or "OPAQUE").upper()
    require(mode == "OPAQUE" or not image.has_transparency_data, str(path), "opaque textures", mode)
    texture = np.asarray(image.convert("RGB"))
    if factor is not None:
        texture = np.round(texture * (np.asarray(factor, np.float64)[:3] / 255)).astype(np.uint8)
    return texture


def _image_beside(path: Path) -> Image.Image | None:
    """Texture of a scan without ``.mtl``: ``material0.*``, or the only image next to it."""
    images = sorted(p for p in path.parent.iterdir() if p.suffix.lower() in _IMAGE_SUFFIXES)
    named = [p for p in images if p.stem.lower() == "material0"]
    chosen = named[:1] or (images if len(images) == 1 else [])
    return read_image(chosen[0]) if chosen else None
