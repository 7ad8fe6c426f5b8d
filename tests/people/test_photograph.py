"""Renderings of analytic shapes: depth, silhouettes, antialiasing, light."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.ndimage import map_coordinates

import ghgs_lit
from ghgs_lit.data.sampling import subject_rng
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.projection import pixel_centers, project, unproject_maps
from ghgs_lit.types import Cameras
from ghgs_people.figures.mesh import Person, TexturedMesh
from ghgs_people.figures.meshing import smooth_normals
from ghgs_people.lights import Lights
from ghgs_people.photograph import Studio
from ghgs_people.rig import Rig


def plain(color=(255, 255, 255), size=4) -> np.ndarray:
    """A texture of one colour."""
    return np.tile(np.array(color, np.uint8), (size, size, 1))


def mesh_part(mesh: trimesh.Trimesh, texture=None) -> TexturedMesh:
    """A mesh in one plain colour."""
    vertices = np.asarray(mesh.vertices, np.float32)
    uv = np.full((len(vertices), 2), 0.5, np.float32)
    return TexturedMesh(vertices, np.asarray(mesh.faces), uv, plain() if texture is None else texture)


def quad(z=0.0, half=0.5, texture=None, x=0.0) -> TexturedMesh:
    """A square that faces +z, with its texture upright as seen from +z."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float32)
    vertices = np.concatenate((corners * half + [x, 0], np.full((4, 1), z)), 1).astype(np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return TexturedMesh(vertices, faces, (corners + 1) / 2, plain() if texture is None else texture)


def front_camera(size=48, distance=2.0, focal=1.0, shift=0.0) -> Cameras:
    """A camera at (0, 0, distance), looking along -z, y up."""
    extrinsics = torch.diag(torch.tensor([1.0, -1, -1, 1]))
    extrinsics[2, 3] = distance
    intrinsics = torch.tensor([[focal * size, 0, size / 2 + shift], [0, focal * size, size / 2], [0, 0, 1]])
    return Cameras(intrinsics[None], extrinsics[None], size, size)


def shoot(parts, cameras, samples=3, lights=None):
    """Image, mask and depth from the first of the cameras."""
    photographs = Studio(Person("p", tuple(parts), None), lights, samples).shoot(cameras)
    return photographs.images[0], photographs.masks[0], photographs.depths[0]


def test_depth_never_mixes_two_surfaces():
    """At edges, depth is that of one surface, never a mean between two."""
    near = quad(z=0.5, half=0.2, x=0.05)
    far = quad(z=-0.5, half=0.9)
    for samples in (1, 2, 3, 4):
        _, mask, depth = shoot([near, far], front_camera(40), samples)
        values = depth[mask]
        assert ((np.abs(values - 1.5) < 1e-5) | (np.abs(values - 2.5) < 1e-5)).all()
        assert (np.abs(values - 1.5) < 1e-5).sum() > 50


def sample_texture(texture, uv):
    """Bilinear colours [n, 3] of a repeating texture, by SciPy in float64."""
    height, width, _ = texture.shape
    places = [(1 - uv[:, 1]) * height - 0.5, uv[:, 0] * width - 0.5]
    return np.stack(
        [map_coordinates(c / 255, places, order=1, mode="grid-wrap") for c in np.moveaxis(texture, 2, 0)], -1
    )


def hits(corners, origins, rays):
    """Distances [m, ...] and barycentric coordinates [m, ..., 2] of all rays on all triangles,
    in float64."""
    a, b, c = (corners[:, i].reshape(-1, *[1] * (rays.ndim - 1), 3) for i in range(3))
    flat = np.cross(b - a, c - a)
    t = ((a - origins) * flat).sum(-1) / (rays * flat).sum(-1)
    offset = origins + t[..., None] * rays - a
    v = (np.cross(offset, c - a) * flat).sum(-1) / (flat**2).sum(-1)
    w = (np.cross(b - a, offset) * flat).sum(-1) / (flat**2).sum(-1)
    t = np.where((np.minimum(np.minimum(v, w), 1 - v - w) >= 0) & (t > 0), t, np.inf)
    return t, np.stack((v, w), -1)


def photographed(part, camera, samples, light):
    """Image, matte and depth of a mesh by the formulas: all rays against all faces, in float64.

    ``light`` [n, 2] has factors on the texture on both sides of the vertices."""
    corners = part.vertices[part.faces].astype(np.float64)
    matrix = camera.intrinsics[0].double().numpy()
    pose = camera.extrinsics[0].double().numpy()
    place = (np.arange(camera.width * samples) + 0.5) / samples
    columns, rows = np.meshgrid(place, place)
    rays = np.stack((columns, rows, np.ones_like(rows)), -1) @ np.linalg.inv(matrix).T @ pose[:3, :3]
    t, mixed = hits(corners, -pose[:3, :3].T @ pose[:3, 3], rays)
    depth = t.min(0)
    image = np.zeros((*rows.shape, 3))
    for face, (a, b, c) in enumerate(corners):
        hit = (t[face] == depth) & np.isfinite(depth)
        v, w = mixed[face][hit].T
        weights = np.stack((1 - v - w, v, w), -1)
        behind = (rays[hit] @ np.cross(b - a, c - a) > 0).astype(int)
        lit = (weights[..., None] * light[part.faces[face]]).sum(1)[np.arange(len(behind)), behind]
        value = sample_texture(part.texture, weights @ part.uv[part.faces[face]]) * lit[:, None]
        image[hit] = np.where(value > 0.8, 1 - 0.04 / np.maximum(value - 0.6, 0.2), value)
    side = (camera.height, samples, camera.width, samples)
    matte = np.isfinite(depth).reshape(side).mean((1, 3))
    middle = slice(samples // 2, None, samples)
    return image.reshape(*side, 3).mean((1, 3)), matte, depth[middle, middle]


@pytest.mark.parametrize("samples", [1, 3])
def test_photograph_follows_its_formulas(samples):
    """Kernels and the selection of rays agree with all rays against all faces in float64."""
    rng = np.random.default_rng(samples)
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    vertices = np.float32(sphere.vertices * rng.uniform(0.6, 1.4, (len(sphere.vertices), 1)))
    uv = np.float32(rng.uniform(-2, 2, (len(vertices), 2)))
    texture = rng.integers(0, 256, (7, 5, 3), np.uint8)
    part = TexturedMesh(vertices, np.asarray(sphere.faces), uv, texture)
    camera = front_camera(40, 1.8, shift=1.3)
    studio = Studio(Person("p", (part,), None), Lights(brightness=0.8).draw(rng), samples)
    taken = studio.shoot(camera)
    corners = part.vertices[part.faces].astype(np.float64)

    def is_blocked(origins, rays):
        return np.isfinite(hits(corners, origins.astype(np.float64), rays.astype(np.float64))[0]).any(0)

    normals = smooth_normals(part.vertices, part.faces)
    light = studio.lights.exposure * studio.lights.shade(part.vertices, normals, is_blocked)
    image, matte, depth = photographed(part, camera, samples, light)
    np.testing.assert_array_equal(taken.alphas[0], np.float32(matte))
    assert 0.3 < matte.mean() < 0.7
    shown = np.isfinite(depth)
    np.testing.assert_allclose(taken.depths[0][shown], depth[shown], rtol=1e-5)
    np.testing.assert_allclose(taken.images[0], image, atol=2e-4)
    assert 0.9 < image.max() < 1  # some highlights were compressed


def test_lights_are_the_same_for_every_view_and_seam_free():
    """Light agrees with its formula on a round body with known normals; UV seams are invisible."""
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    exploded = TexturedMesh(  # every face has its own vertices, as along UV seams
        np.asarray(sphere.triangles, np.float32).reshape(-1, 3),
        np.arange(len(sphere.faces) * 3).reshape(-1, 3),
        np.zeros((len(sphere.faces) * 3, 2), np.float32),
        plain((160, 160, 160)),
    )
    normals = smooth_normals(exploded.vertices, exploded.faces)
    np.testing.assert_allclose(normals, exploded.vertices / 0.5, atol=7e-3)
    cameras = Rig(look_at=(0, 0, 0)).cameras(np.array([0.0, 30.0]), 64, 64)
    studio = Studio(Person("s", (exploded,), None), Lights().draw(np.random.default_rng(1)))
    photographs = studio.shoot(cameras)
    lights = studio.lights
    for n in range(2):
        inner = photographs.masks[n] & (photographs.depths[n] < 1.75)  # off the rim
        assert inner.sum() > 200
        normals = unproject_maps(torch.from_numpy(photographs.depths[n]), cameras[n]).numpy()[inner] / 0.5
        direct = np.maximum(np.einsum("nc,lsc->nls", normals, lights.directions), 0).mean(-1)
        light = lights.ambient * (1 + lights.sky * normals[:, 1]) + direct @ lights.strengths
        expected = np.minimum(lights.exposure * light ** (1 / 2.2) * 160 / 255, 1)
        assert expected.max() < 0.8
        np.testing.assert_allclose(photographs.images[n][inner][:, 0], expected, atol=0.01)


def test_shadows_are_soft():
    """Below a half-plane under a disc light: lit, dark, and in between the visible fraction of the disc."""
    height = 1.0
    fine = np.linspace(-1, 1, 201)
    across, along = np.meshgrid(fine, [-1.0, 1.0])
    points = np.float32(np.stack((across, 0 * across, along), -1).reshape(-1, 3))
    screen = np.array(
        [
            [[0, height, -9], [9, height, -9], [9, height, 9]],
            [[0, height, -9], [9, height, 9], [0, height, 9]],
        ]
    )
    lights = Lights(count=(1, 1), elevation=(90, 90), radius=(20, 20), ambient=(0.1, 0.1), sky=(0, 0))
    lights = lights.draw(np.random.default_rng(0))

    def is_blocked(origins, rays):
        return np.isfinite(hits(screen, origins.astype(np.float64), rays.astype(np.float64))[0]).any(0)

    light = lights.shade(points, np.tile(np.float32([0, 1, 0]), (len(points), 1)), is_blocked)[:201, 0]
    x = np.clip(fine / (height * np.tan(np.radians(20))), -1, 1)
    # part of the disc next to the screen
    share = 1 - (np.pi / 2 + np.arcsin(x) + x * np.sqrt(1 - x**2)) / np.pi
    cosine = (lights.directions[0] @ [0, 1, 0]).mean()
    # Two of twelve samples.
    np.testing.assert_allclose((light**2.2 - 0.1) / lights.strengths[0] / cosine, share, atol=2 / 12)


def test_subjects_are_as_bright_as_real_ones():
    """Mean brightness is about 0.40; white clothes remain brighter than dark ones."""
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    means = {}
    for level in (40, 100, 220):
        person = Person("s", (mesh_part(sphere, plain((level,) * 3)),), None)
        studio = Studio(person, Lights(spread=0).draw(np.random.default_rng(2)))
        taken = studio.shoot(Rig(look_at=(0, 0, 0)).cameras(45.0 * np.arange(8), 48, 48))
        means[level] = taken.images[taken.masks].mean()
    assert 0.25 < means[40] < means[100] < means[220] < 0.65
    assert 0.3 < means[100] < 0.45


def test_both_sides_are_lit_and_winding_does_not_matter():
    """Scans with flipped faces are lit like other scans."""
    lights = Lights(count=(1, 1), ambient=(0.2, 0.2)).draw(np.random.default_rng(0))
    part = quad()
    flipped = TexturedMesh(part.vertices, part.faces[:, ::-1].copy(), part.uv, part.texture)
    one, _, _ = shoot([part], front_camera(16), lights=lights)
    other, _, _ = shoot([flipped], front_camera(16), lights=lights)
    np.testing.assert_allclose(one, other, atol=1e-6)


def test_camera_beside_and_inside_the_subject():
    """An empty view yields empty maps; vertices behind the camera do not make the window too small."""
    away = front_camera(16)
    away.intrinsics[:, 0, 2] += 1000
    _, mask, depth = shoot([quad()], away)
    assert not mask.any()
    assert not depth.any()
    _, mask, depth = shoot([quad(z=0.0, half=5), quad(z=3.0, half=5)], front_camera(16))
    assert mask.all()
    np.testing.assert_allclose(depth, 2.0, atol=1e-5)


def test_ring_has_the_angles_of_the_layout():
    """Cameras are where stereo readers of the THuman2.0 layout expect each view."""
    rig, rng = Rig(), subject_rng(0, "a")
    yaws = rig.yaws(rng)
    cameras = rig.cameras(yaws, 128, 128)
    centers = cameras.centers.double().numpy() - np.array([0, 0.85, 0])
    np.testing.assert_allclose(np.linalg.norm(centers, axis=-1), 2.0, atol=1e-5)
    np.testing.assert_allclose(centers[..., 1], 2 * np.sin(np.radians(8)), atol=1e-5)
    flat = centers[..., [0, 2]]
    angle = np.degrees(np.arctan2(flat[..., 0], flat[..., 1]))
    turn = (angle - angle[:, :1]) % 360
    np.testing.assert_allclose(turn[:, 1], 22.5, atol=1e-3)
    np.testing.assert_allclose(turn[:, 3], 11.25, atol=1e-3)
    assert ((turn[:, 2] > 0) & (turn[:, 2] < 11.25) & (turn[:, 4] > 11.25) & (turn[:, 4] < 22.5)).all()
    np.testing.assert_allclose((angle[1:, 0] - angle[:-1, 0]) % 360, 22.5, atol=1e-3)
    assert abs(yaws[0, 0]) <= 11
    pixel, z = project(torch.tensor([0.0, 0.85, 0]), cameras.intrinsics[0, 0], cameras.extrinsics[0, 0])
    np.testing.assert_allclose(pixel, [64, 64 + 25 / 8], atol=1e-4)
    assert abs(z - 2) < 1e-5
    rotation = cameras.extrinsics[..., :3, :3].double()
    np.testing.assert_allclose(rotation @ rotation.mT, np.broadcast_to(np.eye(3), rotation.shape), atol=1e-6)
    assert (torch.linalg.det(rotation) > 0.99).all()
    assert pixel_centers(2, 2, pixel)[0, 0].tolist() == [0.5, 0.5]


def test_placing_scales_and_moves_body_and_clothes_alike():
    """Subjects stand on the ground with the requested height, with the body still inside the clothes."""
    box = trimesh.creation.box((0.4, 3.0, 0.2))
    part = mesh_part(box)
    part = TexturedMesh(part.vertices + np.float32([5, 7, -2]), part.faces, part.uv, part.texture)
    person = Person("b", (part,), part.vertices[::2].copy())
    placed = Rig().place(person, subject_rng(0, "b"))
    low, high = placed.parts[0].vertices.min(0), placed.parts[0].vertices.max(0)
    assert 1.75 <= high[1] <= 1.85
    np.testing.assert_allclose([low[1], low[0] + high[0], low[2] + high[2]], 0, atol=1e-5)
    np.testing.assert_allclose(placed.body_vertices, placed.parts[0].vertices[::2], atol=1e-6)
    kept = Rig(height=None).place(person, subject_rng(0, "b"))
    np.testing.assert_allclose(np.ptp(kept.parts[0].vertices[:, 1]), 3.0, atol=1e-5)


def test_without_embree_only_rendering_is_refused(monkeypatch):
    """Some machines have no wheel for it; it is imported only to render meshes."""
    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    with pytest.raises(InputError, match="expected the package embreex, or photographs that are rendered"):
        Studio(Person("p", (quad(),), None), None)
    sources = [path.read_text() for path in Path(ghgs_lit.__file__).parent.rglob("*.py")]
    assert not [text for text in sources if re.search(r"^(?:import|from) embreex", text, re.M)]
