"""Rigged meshes: vertices are where joints and morph targets put them, by a slow reference."""

import base64
import io
import json
import struct

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from ghgs_lit.errors import InputError
from ghgs_people.gltf import posed
from ghgs_people.scans import ScanSource

RNG = np.random.default_rng(0)
VERTICES = RNG.uniform(-1, 1, (9, 3)).astype("<f4")
JOINTS = RNG.integers(0, 2, (9, 4)).astype("u1")
WEIGHTS = RNG.integers(1, 255, (9, 4)).astype("u1")
WEIGHTS[8] = 0  # goes with its first joint
TARGET = RNG.uniform(-0.1, 0.1, (9, 3)).astype("<f4")
KINDS = {"u1": 5121, "u2": 5123, "f4": 5126}


def placed(translation=(0, 0, 0), turn=(0, 0, 0), scale=(1, 1, 1)) -> tuple[dict, np.ndarray]:
    """A node, and its matrix."""
    rotation = Rotation.from_euler("xyz", turn, degrees=True)
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.as_matrix() @ np.diag(scale)
    matrix[:3, 3] = translation
    node = {"translation": list(translation), "rotation": rotation.as_quat().tolist(), "scale": list(scale)}
    return node, matrix


class File:
    """A .gltf file that is put together."""

    def __init__(self) -> None:
        self.tree = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], "buffers": []}
        self.content = b""

    def add(self, array: np.ndarray, kind: str) -> int:
        array = np.ascontiguousarray(array)
        view = {"buffer": 0, "byteOffset": len(self.content), "byteLength": array.nbytes}
        self.content += array.tobytes() + bytes(-array.nbytes % 4)
        number = {"bufferView": len(self.tree["bufferViews"]), "componentType": KINDS[array.dtype.str[1:]]}
        self.tree["bufferViews"].append(view)
        self.tree["accessors"].append(
            {**number, "count": array.size if kind == "SCALAR" else len(array), "type": kind}
        )
        return len(self.tree["accessors"]) - 1

    def write(self, path, binary: bool) -> None:
        path.parent.mkdir(exist_ok=True)
        if not binary:
            data = base64.b64encode(self.content).decode()
            buffer = {"byteLength": len(self.content), "uri": f"data:application/octet-stream;base64,{data}"}
            path.write_text(json.dumps(self.tree | {"buffers": [buffer]}))
            return
        tree = json.dumps(self.tree | {"buffers": [{"byteLength": len(self.content)}]}).encode()
        tree += b" " * (-len(tree) % 4)
        chunks = b"".join(
            struct.pack("<I4s", len(part), name) + part
            for name, part in ((b"JSON", tree), (b"BIN\0", self.content))
        )
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def rigged(
    bind: bool = True, morphs: list[float] | None = None, skinned: bool = True
) -> tuple[File, np.ndarray]:
    """A file with a mesh under a node, moved by two joints of a chain;
    and the vertices that are expected."""
    file = File()
    attributes = {
        "POSITION": file.add(VERTICES, "VEC3"),
        "NORMAL": file.add(VERTICES, "VEC3"),
        "TEXCOORD_0": file.add(np.full((9, 2), 0.5, "<f4"), "VEC2"),
    }
    if skinned:
        attributes |= {"JOINTS_0": file.add(JOINTS, "VEC4"), "WEIGHTS_0": file.add(WEIGHTS, "VEC4")}
        file.tree["accessors"][-1]["normalized"] = True
    primitive = {
        "attributes": attributes,
        "indices": file.add(np.arange(9, dtype="<u2"), "SCALAR"),
        "material": 0,
    }
    mesh, vertices = {"primitives": [primitive]}, VERTICES.astype(np.float64)
    if morphs is not None:
        primitive["targets"] = [{"NORMAL": 0}, {"POSITION": file.add(TARGET, "VEC3")}]
        mesh["weights"] = morphs
        vertices = vertices + morphs[1] * TARGET
    root, root_matrix = placed((0, 0.5, 0), (0, 90, 0), (2, 2, 2))
    hip, hip_matrix = placed((0.1, 1, 0), (0, 0, 30))
    knee, knee_matrix = placed((0, -0.4, 0), (70, 0, 0), (1, 1.2, 1))
    body, body_matrix = placed((5, 5, 5), (10, 20, 30))
    # 0 root, 1 hip, 2 knee, 3 the mesh, whose own place does not matter where it is skinned
    nodes = [root | {"children": [1, 3]}, hip | {"children": [2]}, knee, body | {"mesh": 0}]
    skin = {"joints": [2, 1]}
    inverse = np.stack([placed((0, 1, 2), (40, 0, 5))[1], placed((3, 0, 1), (0, 50, 0))[1]])
    if bind:
        columns = inverse.swapaxes(1, 2).reshape(2, 16).astype("<f4")
        skin["inverseBindMatrices"] = file.add(columns, "MAT4")
    if skinned:
        nodes[3]["skin"] = 0
    file.tree |= {
        "meshes": [mesh],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": [0.2, 0.4, 0.6, 1]}}],
        "nodes": nodes,
        "skins": [skin],
        "scenes": [{"nodes": [0]}],
    }
    joints = [root_matrix @ hip_matrix @ knee_matrix, root_matrix @ hip_matrix]
    expected = []
    for n, vertex in enumerate(vertices):
        point, place = np.array([*vertex, 1]), np.zeros(4)
        weights = WEIGHTS[n] / WEIGHTS[n].sum() if n < 8 else [1.0, 0, 0, 0]
        if not skinned:
            place = root_matrix @ body_matrix @ point
        else:
            for joint, weight in zip(JOINTS[n], weights, strict=True):
                place += weight * (joints[joint] @ (inverse[joint] if bind else np.eye(4)) @ point)
        expected.append(place[:3])
    return file, np.array(expected)


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("bind", [True, False])
@pytest.mark.parametrize("morphs", [None, [0.3, 0.7]])
def test_a_rigged_mesh_is_where_its_joints_put_it(tmp_path, binary, bind, morphs):
    """Skins were not followed: eyes as large as people, and a check that was content."""
    file, expected = rigged(bind, morphs)
    file.write(tmp_path / "g" / ("g.glb" if binary else "g.gltf"), binary)
    (part,) = ScanSource(tmp_path).load("g").parts
    np.testing.assert_allclose(part.vertices, expected, atol=1e-5)
    assert part.texture.tolist() == [[[51, 102, 153]]]
    np.testing.assert_array_equal(part.uv, 0.5)


def test_morph_targets_of_a_mesh_without_joints(tmp_path):
    """It keeps its place in the scene."""
    file, expected = rigged(morphs=[0.3, 0.7], skinned=False)
    file.write(tmp_path / "g" / "g.glb", True)
    np.testing.assert_allclose(ScanSource(tmp_path).load("g").parts[0].vertices, expected, atol=1e-5)


def test_what_nothing_moves_is_left_as_it_is(tmp_path):
    file, expected = rigged(morphs=[0.0, 0.0], skinned=False)
    file.write(tmp_path / "g" / "g.glb", True)
    assert posed(tmp_path / "g" / "g.glb") is None
    np.testing.assert_allclose(ScanSource(tmp_path).load("g").parts[0].vertices, expected, atol=1e-5)


def test_a_mesh_that_two_skins_move(tmp_path):
    """Each node has its own copy."""
    file, expected = rigged()
    file.tree["nodes"][0]["children"].append(4)
    file.tree["nodes"].append({"mesh": 0, "skin": 1})
    file.tree["skins"].append(file.tree["skins"][0] | {"joints": [1, 2]})
    file.write(tmp_path / "g" / "g.glb", True)
    one, other = ScanSource(tmp_path).load("g").parts
    assert min(np.abs(part.vertices - expected).max() for part in (one, other)) < 1e-5
    assert np.abs(one.vertices - other.vertices).max() > 0.1


def test_a_rigged_mesh_that_no_scene_shows(tmp_path):
    """Such as another level of detail."""
    file, expected = rigged()
    file.tree["nodes"].append({"mesh": 0, "skin": 0, "translation": [9, 9, 9]})
    file.write(tmp_path / "g" / "g.glb", True)
    (part,) = ScanSource(tmp_path).load("g").parts
    np.testing.assert_allclose(part.vertices, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("spoil", "line"),
    [
        (lambda tree: tree["skins"][0].update(joints=[2]), "expected a readable mesh; found IndexError"),
        (lambda tree: tree["nodes"][3].update(skin=7), "expected a readable mesh; found IndexError"),
        (lambda tree: tree["accessors"][0].update(count=10**6), "expected a readable mesh; found ValueError"),
        (
            lambda tree: tree["accessors"][0].update(sparse={}),
            "found ValueError..a sparse accessor",
        ),
        (lambda tree: tree.update(meshes=[]), "expected a readable mesh; found IndexError"),
    ],
)
def test_broken_rigs_are_named(tmp_path, spoil, line):
    file, _ = rigged()
    spoil(file.tree)
    file.write(tmp_path / "g" / "g.glb", True)
    with pytest.raises(InputError, match=rf"g\.glb: .*{line}"):
        ScanSource(tmp_path).load("g")


UV = RNG.uniform(0, 1, (9, 2)).astype("<f4")
TURN = np.array([[0.6, 0.8], [-0.8, 0.6]])  # counter-clockwise, while v points down


@pytest.mark.parametrize(
    ("array", "texture", "expected"),
    [
        (UV, {"texCoord": 1}, UV),
        (np.round(UV * 255).astype("u1"), {"texCoord": 1}, np.round(UV * 255) / 255),
        (UV, {"texCoord": 0, "extensions": {"KHR_texture_transform": {"texCoord": 1}}}, UV),
        (
            UV,
            {
                "texCoord": 1,
                "extensions": {
                    "KHR_texture_transform": {
                        "offset": [0.1, 0.2],
                        "rotation": float(np.arctan2(0.8, 0.6)),
                        "scale": [0.5, 2],
                    }
                },
            },
            (UV * [0.5, 2]) @ TURN.T + [0.1, 0.2],
        ),
    ],
)
@pytest.mark.parametrize("moved", [False, True])
def test_a_texture_is_read_where_its_material_puts_it(tmp_path, array, texture, expected, moved):
    file, _ = textured(array, texture, moved)
    file.write(tmp_path / "g" / "g.glb", True)
    (part,) = ScanSource(tmp_path).load("g").parts
    np.testing.assert_allclose(part.uv, np.stack((expected[:, 0], 1 - expected[:, 1]), 1), atol=1e-6)


def textured(array: np.ndarray, texture: dict, moved: bool = False) -> tuple[File, dict]:
    """A file with a second set of coordinates, and its tree."""
    file, _ = rigged(morphs=[0.3, 0.7] if moved else None, skinned=False)
    image = io.BytesIO()
    Image.new("RGB", (2, 2)).save(image, "PNG")
    content = np.frombuffer(image.getvalue(), "u1")
    view = file.tree["accessors"][file.add(content, "SCALAR")]["bufferView"]
    index = file.add(array, "VEC2")
    file.tree["accessors"][index]["normalized"] = array.dtype.kind == "u"
    file.tree["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_1"] = index
    file.tree |= {
        "images": [{"bufferView": view, "mimeType": "image/png"}],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, **texture}}}],
    }
    return file, file.tree


@pytest.mark.parametrize(
    ("texture", "sampler", "line"),
    [
        ({"texCoord": 2}, {}, "expected texture coordinates"),
        (
            {"extensions": {"KHR_texture_transform": {"scale": [3, 1]}}},
            {"wrapS": 33071},
            "expected repeated textures; found 'wrapS 33071",
        ),
    ],
)
def test_what_of_a_texture_cannot_be_applied_is_named(tmp_path, texture, sampler, line):
    file, tree = textured(UV, texture)
    tree["samplers"] = [sampler]
    file.write(tmp_path / "g" / "g.glb", True)
    with pytest.raises(InputError, match=line):
        ScanSource(tmp_path).load("g")
