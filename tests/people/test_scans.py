"""Scans on disk: loaded unchanged, rendered with one transform, and invalid ones reported."""

import json
import re

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from ghgs_lit.data.layout import Layout
from ghgs_lit.errors import InputError
from ghgs_people.scans import ScanSource
from tests.helpers.captures import points_of, refused
from tests.helpers.people import render_boxes, write_obj_scan


def test_obj_scans_are_loaded_as_they_are(tmp_path):
    """Vertices, texture and body equal those in the files; a missing .mtl does not matter."""
    write_obj_scan(tmp_path, "a", (200, 90, 30))
    person = ScanSource(tmp_path).load("a")
    part = person.parts[0]
    np.testing.assert_allclose(part.vertices.min(0), [1 - 0.205, 1.25, 2.85], atol=1e-5)
    assert np.abs(part.texture.reshape(-1, 3).mean(0) - [200, 90, 30]).max() < 3
    assert person.body_vertices.dtype == np.float32
    assert len(person.body_vertices) == 8
    # often lost: the picture next to the mesh is found anyway
    (tmp_path / "a" / "material0.mtl").unlink()
    assert ScanSource(tmp_path).load("a").parts[0].texture.shape == (4, 4, 3)


def test_names_of_windows_programs(tmp_path):
    """Upper case, backslashes, folders of another machine, options of map_Kd, names with spaces."""
    write_obj_scan(tmp_path, "a", (200, 90, 30))
    folder = tmp_path / "a"
    (folder / "textures").mkdir()
    (folder / "material0.jpeg").rename(folder / "textures" / "My Skin.JPEG")
    # next to the mesh, so that nothing is guessed
    Image.new("RGB", (4, 4)).save(folder / "black.png")
    Image.new("RGB", (4, 4)).save(folder / "white.png")
    (folder / "material0.mtl").rename(folder / "Material0.MTL")
    (folder / "a.obj").rename(folder / "a.OBJ")
    for said in (
        "textures\\My Skin.jpeg",
        "textures/my skin.jpeg",
        ".\\textures\\My Skin.JPEG",
        "textures\\My%20Skin.JPEG",
    ):
        (folder / "Material0.MTL").write_text(f"newmtl material0\nmap_Kd {said}\n")
        texture = ScanSource(tmp_path).load("a").parts[0].texture
        assert np.abs(texture.reshape(-1, 3).mean(0) - [200, 90, 30]).max() < 3
    (folder / "textures" / "My Skin.JPEG").rename(folder / "skin.JPEG")
    for said in ("C:\\Users\\me\\skin.jpeg", "-s 1 1 1 skin.jpeg", '"skin.jpeg"'):
        (folder / "Material0.MTL").write_text(f"newmtl material0\nmap_Kd {said}\n")
        assert np.abs(ScanSource(tmp_path).load("a").parts[0].texture[0, 0] - [200.0, 90, 30]).max() < 3
    assert ScanSource(tmp_path).names() == ["a"]
    for said in ("-s 2 1 1 skin.jpeg", "-blendu on -o 0.5 0 0 skin.jpeg", "-clamp on skin.jpeg"):
        (folder / "Material0.MTL").write_text(f"newmtl material0\nmap_Kd {said}\n")
        line = "expected map_Kd without -s, -o, -t and -clamp; found '-"
        refused(line, lambda: ScanSource(tmp_path).load("a"))


def test_folders_with_meshes_of_other_names_are_named(tmp_path, caplog):
    """They are reported; folders without meshes and hidden ones are not scans."""
    for name in ("a", "b", "fits", ".c"):
        write_obj_scan(tmp_path, name)
    (tmp_path / "b" / "b.obj").rename(tmp_path / "b" / "scan.FBX")
    (tmp_path / "fits" / "fits.obj").unlink()
    assert ScanSource(tmp_path).names() == ["a"]
    (line,) = caplog.messages
    assert line.endswith("no scans, since their meshes are not named as b/b.obj: b")


def test_a_lost_texture_of_several_is_not_guessed(tmp_path):
    """The image next to the mesh is used for an only material, not for one of several without its own."""
    path = write_obj_scan(tmp_path, "a")
    lines = path.read_text().splitlines()
    second = next(i for i, line in enumerate(lines) if line.startswith("f ")) + 4
    path.write_text("\n".join([*lines[:second], "usemtl other", *lines[second:]]))
    mtl = "newmtl material0\nmap_Kd material0.jpeg\nnewmtl other\nmap_Kd lost.png\n"
    (tmp_path / "a" / "material0.mtl").write_text(mtl)
    refused(r"a\.obj: expected a texture for the mesh .*; found none", lambda: ScanSource(tmp_path).load("a"))


def test_glb_scans_keep_parts_and_frames(tmp_path):
    """Parts keep their transforms; a mesh without texture, or with a transparent one, is rejected."""
    scene = trimesh.Scene()
    for k, mode in enumerate(("OPAQUE", "OPAQUE", "MASK")):
        mesh = trimesh.creation.box((0.1, 0.2, 0.3))
        texture = Image.fromarray(np.full((4, 4, 4), 50 * k, np.uint8))
        material = PBRMaterial(baseColorTexture=texture, alphaMode=mode)
        mesh.visual = TextureVisuals(uv=np.zeros((len(mesh.vertices), 2)), material=material)
        scene.add_geometry(
            mesh, node_name=f"n{k}", transform=trimesh.transformations.translation_matrix([0, k, 0])
        )
    (tmp_path / "g").mkdir()
    scene.export(tmp_path / "g" / "g.glb")
    with pytest.raises(InputError, match=r"g\.glb: expected opaque textures; found 'MASK'"):
        ScanSource(tmp_path).load("g")
    scene.delete_geometry(list(scene.geometry)[2])
    scene.export(tmp_path / "g" / "g.glb")
    parts = ScanSource(tmp_path).load("g").parts
    assert [part.texture.shape[2] for part in parts] == [3, 3]
    np.testing.assert_allclose([part.vertices[:, 1].mean() for part in parts], [0, 1], atol=1e-6)
    plain = trimesh.Scene([trimesh.creation.box()])
    plain.export(tmp_path / "g" / "g.glb")
    with pytest.raises(InputError, match=r"g\.glb: expected a texture for the mesh"):
        ScanSource(tmp_path).load("g")


RIGGED = "expected a mesh at rest with one set of texture coordinates"
COMPRESSED = r"expected a mesh without extensions \(npx @gltf-transform/cli dequantize "


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            {"extensionsRequired": ["KHR_materials_unlit", "KHR_draco_mesh_compression"]},
            f"{COMPRESSED}.*'KHR_draco",
        ),
        ({"skins": [{"joints": [0]}]}, f"{RIGGED}.*; found 'skins'"),
        ({"animations": [{}]}, f"{RIGGED}.*; found 'animations'"),
        ({"meshes": [{"primitives": [{"attributes": {}, "targets": [{}]}]}]}, f"{RIGGED}.*'morph targets'"),
        ({"extensionsUsed": ["KHR_texture_transform"]}, f"{RIGGED}.*'KHR_texture_transform'"),
        (
            {
                "accessors": [{"componentType": 5121}],
                "meshes": [{"primitives": [{"attributes": {"TEXCOORD_0": 0}}]}],
            },
            f"{RIGGED}.*'TEXCOORD_0 of whole numbers'",
        ),
        (
            {"materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"texCoord": 1}}}]},
            f"{RIGGED}.*'texCoord above 0'",
        ),
        ({"meshes": [{}]}, "expected a readable mesh; found KeyError"),
    ],
)
@pytest.mark.parametrize("binary", [True, False])
def test_a_gltf_file_that_would_be_read_as_another_mesh_is_named_with_its_cure(
    tmp_path, change, line, binary
):
    path = tmp_path / "g" / ("g.glb" if binary else "g.gltf")
    path.parent.mkdir()
    content = json.dumps(change).encode()
    header = b"glTF" + np.array([2, 20 + len(content), len(content)], "<u4").tobytes() + b"JSON"
    path.write_bytes((header if binary else b"") + content)
    refused(f"{path.name}: {line}", lambda: ScanSource(tmp_path).load("g"))


BAD = {
    "far away": (
        lambda path: path.write_text(re.sub(r"(?m)^v \S+", "v 1e30", path.read_text(), count=1)),
        r"a\.obj: .*: expected coordinates below 1e\+06; found",
    ),
    "no mesh": (lambda path: path.write_text("f 1 2 3\n"), r"a\.obj: expected"),
    "no file": (lambda path: path.unlink(), r"a: expected a\.obj or a\.glb; found neither"),
    "flat body": (
        lambda path: np.save(path.with_name("body_vertices.npy"), np.zeros((5, 2))),
        r"body_vertices\.npy: expected an array nx3; found 5x2",
    ),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_scans_are_named(tmp_path, kind):
    """Every defect of a scan is reported with its path."""
    damage, line = BAD[kind]
    damage(write_obj_scan(tmp_path, "a"))
    refused(line, lambda: ScanSource(tmp_path).load("a"))


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("nowhere", "nowhere: expected a folder of scans; found no such folder"),
        ("", r"expected <id>/<id>\.obj or <id>/<id>\.glb; found none"),
    ],
)
def test_folders_without_scans_are_named(tmp_path, name, line):
    refused(line, ScanSource(tmp_path / name).names)


def test_rendered_scans_share_one_transform(tmp_path):
    """Depth and body vertices of a rendered scan agree; here the body is the box itself."""
    render_boxes(tmp_path / "out", tmp_path / "scans", train=1, val=0)
    layout = Layout(tmp_path / "out", "train")
    body = layout.read_body("s0")
    assert body[:, 1].min() == pytest.approx(0, abs=2e-3)  # stored in 16 bits next to the mesh
    assert 1.75 <= np.ptp(body[:, 1]) <= 1.85
    for position in layout.subjects["s0"][::5]:
        for number in layout.views_at("s0", position):
            view = layout.read_view("s0", position, number, depth=True)
            points = points_of(view)[view.mask]
            assert (points > body.min(0) - 0.05).all()
            assert (points < body.max(0) + 0.05).all()
