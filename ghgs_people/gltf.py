"""glTF and GLB files with the vertices where skins and morph targets put them, and coordinates where
the transform of a texture does: trimesh reads none of these."""

import base64
import copy
import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from scipy.spatial.transform import Rotation

from ghgs_lit.errors import InputError, require
from ghgs_lit.parsing import find_path

_NUMBERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
# Kinds of a GLB's chunks.
_JSON = 0x4E4F534A
_BIN = 0x004E4942
# Extensions without which a reader would see another mesh or texture,
# though a file may require them.
_READ = ("EXT_texture_webp", "KHR_lights_punctual", "KHR_materials_", "KHR_texture_transform")
_REPEAT = 10497  # how textures go on outside of their image, if nothing is said


def posed(path: Path) -> dict[str, Any] | None:
    """Read a file with all vertices where its skins, joints and weights of morph targets put them,
    and with the coordinates at which its textures are read as the first ones.

    Section 3.7.3 of the specification of glTF 2.0: a vertex of a skinned mesh is the mean, by its
    weights, of where its joints put it, in the world of the scene.

    Args:
        path: of a ``.gltf`` or ``.glb`` file.

    Returns:
        The content of a ``.gltf`` file with its buffers inside; None where nothing moves either.

    Raises:
        InputError: the file cannot be read, or requires an extension that is not read.
    """
    try:
        tree, buffers = _read(path)
        _check_extensions(path, tree)
        nodes = [(i, node) for i, node in enumerate(tree.get("nodes", [])) if "mesh" in node]
        moved = [(i, node) for i, node in nodes if "skin" in node or any(_morphs(tree, node))]
        if not _place_textures(path, tree, buffers) and not moved:
            return None
        worlds = _worlds(tree)
        shown = _shown(tree)
        for i, node in moved:
            if i in shown:
                _pose(tree, buffers, node, worlds)
    except InputError:
        raise
    except Exception as error:  # a broken file raises whatever its entries are good for
        raise InputError(f"{path}: expected a readable mesh; found {error!r}") from error
    for entry, content in zip(tree["buffers"], buffers, strict=True):
        entry |= {"uri": _data_uri(content), "byteLength": len(content)}
    return tree


def _read(path: Path) -> tuple[dict[str, Any], list[bytes]]:
    """The tree of a file and the content of its buffers."""
    content = path.read_bytes()
    binary = b""
    if content[:4] == b"glTF":
        chunks = {}
        start = 12
        while start + 8 <= len(content):
            length, kind = np.frombuffer(content, "<u4", 2, start).tolist()
            chunks.setdefault(kind, content[start + 8 : start + 8 + length])
            start += 8 + length
        content = chunks[_JSON]
        binary = chunks.get(_BIN, b"")
    tree = json.loads(content)
    buffers = []
    for entry in tree.get("buffers", []):
        uri = entry.get("uri")
        if uri is None:
            buffers.append(binary)
        elif uri.startswith("data:"):
            buffers.append(base64.b64decode(uri.partition(",")[2]))
        else:
            file = find_path(path.parent, unquote(uri))
            require(file is not None, str(path), f"its buffer {uri} beside it", "no such file")
            buffers.append(file.read_bytes())
    return tree, buffers


def _check_extensions(path: Path, tree: dict[str, Any]) -> None:
    required = [name for name in tree.get("extensionsRequired", []) if not name.startswith(_READ)]
    expected = (
        "a mesh without extensions (npx @gltf-transform/cli dequantize in.glb out.glb removes"
        " compression, or export it uncompressed)"
    )
    require(not required, str(path), expected, ", ".join(required))


def _place_textures(path: Path, tree: dict[str, Any], buffers: list[bytes]) -> bool:
    """Give primitives the coordinates at which their texture is read as ``TEXCOORD_0``: those of
    another set, of whole numbers, or transformed (KHR_texture_transform).

    Args:
        path: of the file, for messages.
        tree: content of the file; accessors are added, primitives changed.
        buffers: of the file; those of the coordinates are added.

    Returns:
        Whether anything was changed.

    Raises:
        InputError: a texture that does not repeat is read outside of its image.
    """
    changed = False
    for primitive in (each for mesh in tree.get("meshes", []) for each in mesh["primitives"]):
        material = tree["materials"][primitive["material"]] if "material" in primitive else {}
        texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
        transform = texture.get("extensions", {}).get("KHR_texture_transform", {})
        chosen = f"TEXCOORD_{transform.get('texCoord', texture.get('texCoord', 0))}"
        index = primitive["attributes"].get(chosen)
        if not texture or index is None:
            if texture:  # never those of another set
                primitive["attributes"].pop("TEXCOORD_0", None)
                changed = True
            continue
        uv = _values(tree, buffers, index)
        sampler = tree["textures"][texture["index"]].get("sampler")
        wraps = {} if sampler is None else tree["samplers"][sampler]
        is_plain = chosen == "TEXCOORD_0" and not transform and uv.dtype == np.float32
        if uv.dtype != np.float32:
            uv = uv / np.iinfo(uv.dtype).max
        angle = transform.get("rotation", 0)
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        uv = (uv * transform.get("scale", [1, 1])) @ turn.T + transform.get("offset", [0, 0])
        for axis, wrap in enumerate(("wrapS", "wrapT")):
            is_inside = uv[:, axis].min() > -1e-3 and uv[:, axis].max() < 1 + 1e-3
            found = f"{wrap} {wraps.get(wrap)} and coordinates outside of the image"
            require(is_inside or wraps.get(wrap, _REPEAT) == _REPEAT, str(path), "repeated textures", found)
        if not is_plain:
            primitive["attributes"]["TEXCOORD_0"] = _add(tree, buffers, uv)
            changed = True
    return changed


def _morphs(tree: dict[str, Any], node: dict[str, Any]) -> list[float]:
    """Weights of the morph targets of a node's mesh."""
    return node.get("weights") or tree["meshes"][node["mesh"]].get("weights") or []


def _worlds(tree: dict[str, Any]) -> dict[int, np.ndarray]:
    """Matrices [4, 4] from each node to the world."""
    nodes = tree["nodes"]
    below = set()
    for node in nodes:
        below.update(node.get("children", []))
    worlds: dict[int, np.ndarray] = {}
    waiting = [(i, np.eye(4)) for i in range(len(nodes)) if i not in below]
    while waiting:
        i, parent = waiting.pop()
        worlds[i] = parent @ _matrix(nodes[i])
        waiting += [(child, worlds[i]) for child in nodes[i].get("children", []) if child not in worlds]
    return worlds


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """The matrix [4, 4] of a node: given, or its translation, rotation (x, y, z, w) and scale."""
    if "matrix" in node:
        return np.reshape(node["matrix"], (4, 4)).T.astype(np.float64)
    matrix = np.eye(4)
    rotation = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix()
    matrix[:3, :3] = rotation * np.asarray(node.get("scale", [1, 1, 1]), np.float64)
    matrix[:3, 3] = node.get("translation", [0, 0, 0])
    return matrix


def _shown(tree: dict[str, Any]) -> set[int]:
    """Nodes of the scene that a viewer shows."""
    scenes = tree.get("scenes", [])
    waiting = (
        list(scenes[tree.get("scene", 0)].get("nodes", [])) if scenes else list(range(len(tree["nodes"])))
    )
    shown: set[int] = set()
    while waiting:
        i = waiting.pop()
        if i not in shown:
            shown.add(i)
            waiting += tree["nodes"][i].get("children", [])
    return shown


def _pose(
    tree: dict[str, Any], buffers: list[bytes], node: dict[str, Any], worlds: dict[int, np.ndarray]
) -> None:
    """Give a node a mesh of its own, whose vertices are moved.

    A skinned one leaves its place in the scene, since joints alone say where it is.

    Args:
        tree: content of the file; meshes, nodes and accessors are added.
        buffers: of the file; those of the moved vertices are added.
        node: of ``tree``, with a mesh; changed in place.
        worlds: matrices [4, 4] from each node to the world, by its index.
    """
    mesh = copy.deepcopy(tree["meshes"][node["mesh"]])
    morphs = _morphs(tree, node)
    skin = tree["skins"][node["skin"]] if "skin" in node else None
    for primitive in mesh["primitives"]:
        attributes = primitive["attributes"]
        vertices = _values(tree, buffers, attributes["POSITION"]).astype(np.float64)
        for weight, target in zip(morphs, primitive.get("targets", []), strict=False):
            if weight and "POSITION" in target:
                vertices = vertices + weight * _values(tree, buffers, target["POSITION"])
        if skin is not None and "JOINTS_0" in attributes:
            vertices = _skinned(tree, buffers, attributes, vertices, skin, worlds)
        index = _add(tree, buffers, vertices)
        # Normals are of the file's pose; ours are made of the faces.
        kept = {key: value for key, value in attributes.items() if key.startswith(("TEXCOORD", "COLOR"))}
        primitive["attributes"] = {"POSITION": index, **kept}
    tree["meshes"].append(mesh)
    posed_node = {"name": f"posed {len(tree['meshes'])}", "mesh": len(tree["meshes"]) - 1}
    if skin is None:
        node["mesh"] = posed_node["mesh"]
        return
    del node["mesh"], node["skin"]
    tree["nodes"].append(posed_node)
    tree["scenes"][tree.get("scene", 0)]["nodes"].append(len(tree["nodes"]) - 1)


def _skinned(
    tree: dict[str, Any],
    buffers: list[bytes],
    attributes: dict[str, int],
    vertices: np.ndarray,
    skin: dict[str, Any],
    worlds: dict[int, np.ndarray],
) -> np.ndarray:
    """Put vertices where joints put them in the world (section 3.7.3 of the
    specification of glTF 2.0).

    Args:
        tree: content of the file.
        buffers: of the file.
        attributes: index of the accessor of each of the primitive's attributes, by name.
        vertices: [n, 3] of the primitive, with its morph targets.
        skin: entry of ``skins`` that names joints and their inverse matrices.
        worlds: matrices [4, 4] from each node to the world, by its index.

    Returns:
        [n, 3] in the world.
    """
    joints = np.stack([worlds[joint] for joint in skin["joints"]])
    if "inverseBindMatrices" in skin:
        inverse = _values(tree, buffers, skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
        joints = joints @ inverse[: len(joints)]
    sets = range(sum(key.startswith("JOINTS_") for key in attributes))
    chosen = np.concatenate([_values(tree, buffers, attributes[f"JOINTS_{i}"]) for i in sets], 1)
    weights = np.concatenate([_values(tree, buffers, attributes[f"WEIGHTS_{i}"]) for i in sets], 1)
    weights = weights.astype(np.float64)
    # a vertex without weights goes with its first joint, as in viewers
    weights[weights.sum(1) <= 0, 0] = 1
    total = weights.sum(1, keepdims=True)
    points = np.concatenate((vertices, np.ones((len(vertices), 1))), 1)
    moved = np.zeros_like(vertices)
    for column in range(chosen.shape[1]):
        each = np.einsum("nij,nj->ni", joints[chosen[:, column].astype(int), :3], points)
        moved += (weights[:, column : column + 1] / total) * each
    return moved


def _values(tree: dict[str, Any], buffers: list[bytes], index: int) -> np.ndarray:
    """Read an accessor (section 3.6.2 of the specification of glTF 2.0).

    Args:
        tree: content of the file.
        buffers: of the file.
        index: of the accessor.

    Returns:
        Array [n, columns], a view of its buffer.

    Raises:
        ValueError: the accessor is sparse.
    """
    entry = tree["accessors"][index]
    if "sparse" in entry:
        raise ValueError("a sparse accessor of a rigged mesh")
    view = tree["bufferViews"][entry["bufferView"]]
    number = np.dtype(_NUMBERS[entry["componentType"]])
    columns = _COLUMNS[entry["type"]]
    start = view.get("byteOffset", 0) + entry.get("byteOffset", 0)
    strides = (view.get("byteStride") or columns * number.itemsize, number.itemsize)
    return np.ndarray((entry["count"], columns), number, buffers[view["buffer"]], start, strides)


def _add(tree: dict[str, Any], buffers: list[bytes], vertices: np.ndarray) -> int:
    """Store vertices or coordinates of a texture in a buffer of their own.

    Args:
        tree: content of the file, to which accessor, view and buffer are added.
        buffers: of the file, to which the bytes are added.
        vertices: [n, 3] or [n, 2].

    Returns:
        Index of their accessor.
    """
    buffers.append(vertices.astype("<f4").tobytes())
    tree["buffers"].append({})
    tree["bufferViews"].append({"buffer": len(buffers) - 1, "byteLength": len(buffers[-1])})
    accessor = {"bufferView": len(tree["bufferViews"]) - 1, "componentType": 5126}
    accessor["type"] = f"VEC{vertices.shape[1]}"
    tree["accessors"].append({**accessor, "count": len(vertices)})
    return len(tree["accessors"]) - 1


def _data_uri(content: bytes) -> str:
    return f"data:application/octet-stream;base64,{base64.b64encode(content).decode()}"
