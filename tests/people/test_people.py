"""Built-in people: the body model, and generated people."""

from importlib.resources import files

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from ghgs_people.figures import Person, TexturedMesh, generate
from ghgs_people.figures.body import BODY_VERTICES, bone_transforms, load_body, skin
from ghgs_people.figures.charts import chart
from ghgs_people.figures.generate import arm_depth, pose_figure
from ghgs_people.figures.meshing import (
    clip,
    neighbour_mean,
    rasterise,
    subdivide,
    triangles,
    vertex_normals,
)
from ghgs_people.figures.noise import Noise
from ghgs_people.figures.place import CROTCH
from tests.helpers.captures import refused

MEGABYTE = 2**20


@pytest.fixture(scope="module")
def people() -> list[Person]:
    """Eight people of one seed for all tests, the last two in motion."""
    return [generate(7, index, active=index > 5) for index in range(8)]


def _all_vertices(person: Person) -> np.ndarray:
    """Vertices of all parts."""
    return np.concatenate([part.vertices for part in person.parts])


# ---- the asset and the body model


def test_asset_is_small_and_comes_with_its_licence():
    """The package is small, and includes the licence of the MakeHuman data."""
    assets = files("ghgs_people.figures") / "assets"
    assert len((assets / "body.npz").read_bytes()) < 4 * MEGABYTE
    licence = (assets / "LICENSE").read_text()
    assert "CC0 1.0 Universal" in licence
    assert "MakeHuman" in licence


def test_weights_sum_to_one_and_parents_come_first():
    """Skinning weights that do not sum to 1 would scale the body;
    posing needs parents before children."""
    body = load_body()
    np.testing.assert_allclose(body.weights.sum(1), 1.0, atol=1e-9)
    assert (body.weights >= 0).all()
    assert ((body.weights > 0).sum(1) <= 8).all()
    assert (body.bone_parents < np.arange(len(body.bone_parents))).all()
    for name in ("head", "skin", "upper", "lower", "skirt", "shoes", "scalp"):
        np.testing.assert_allclose(chart(name).weights.sum(1), 1.0, atol=1e-9)


def test_turning_every_bone_turns_the_whole_body():
    """One rotation of all bones is a rigid motion: skinning neither bends nor shears."""
    body = load_body()
    rest, joints = body.rest(body.bodies[5])
    turn = Rotation.from_rotvec([0.3, -0.7, 0.2]).as_matrix()
    rotations = np.tile(turn, (len(joints), 1, 1))
    transforms = bone_transforms(body.bone_parents, joints, rotations, turn @ joints[0] + [1, 2, 3])
    np.testing.assert_allclose(skin(rest, body.weights, transforms), rest @ turn.T + [1, 2, 3], atol=1e-9)


def test_bones_keep_their_length_and_joints_lie_inside():
    """Posing neither stretches bones nor moves joints out of the body."""
    body = load_body()
    rng = np.random.default_rng(1)
    figure = pose_figure(body, body.sample_shape(rng)[0], rng)
    posed = np.einsum("bij,bj->bi", figure.transforms[:, :, :3], figure.joints) + figure.transforms[:, :, 3]
    child = np.flatnonzero(body.bone_parents >= 0)
    parent = body.bone_parents[child]
    before = np.linalg.norm(figure.joints[child] - figure.joints[parent], axis=1)
    np.testing.assert_allclose(np.linalg.norm(posed[child] - posed[parent], axis=1), before, atol=1e-9)
    inside = (posed > figure.posed.min(0) - 1e-6) & (posed < figure.posed.max(0) + 1e-6)
    assert inside.all()


def test_shapes_are_adults():
    """Stored bodies have the heights of adults and differ in them."""
    body = load_body()
    heights = []
    for index in range(0, len(body.bodies), 8):
        rest, _ = body.rest(body.bodies[index])
        heights.append(np.ptp(rest[:BODY_VERTICES, 1]))
    assert min(heights) > 1.5
    assert max(heights) < 1.9
    assert np.std(heights) > 0.04


# ---- people


def test_same_numbers_same_person(people):
    """The same seed and index yield the same arrays, on which the cache of rendered people relies."""
    again = generate(7, 2)
    assert again.name == people[2].name
    standing = generate(7, 6)  # the same person in another pose
    assert (standing.name, people[6].name) == ("person_7_0006", "active_7_0006")
    assert np.abs(standing.body_vertices - people[6].body_vertices).max() > 0.2
    np.testing.assert_array_equal(again.body_vertices, people[2].body_vertices)
    for one, two in zip(again.parts, people[2].parts, strict=True):
        np.testing.assert_array_equal(one.vertices, two.vertices)
        np.testing.assert_array_equal(one.faces, two.faces)
        np.testing.assert_array_equal(one.uv, two.uv)
        np.testing.assert_array_equal(one.texture, two.texture)


def test_no_two_alike(people):
    """Other numbers yield other shapes, poses and colours."""
    people = [*people, generate(8, 2)]
    assert len({person.name for person in people}) == len(people)
    for i, one in enumerate(people):
        for two in people[:i]:
            assert np.abs(one.body_vertices - two.body_vertices).max() > 0.05
            assert not np.array_equal(one.parts[0].texture, two.parts[0].texture)


def test_stands_on_the_ground_near_the_origin(people):
    """Camera rigs look at the origin: nobody floats, sinks into the ground or is off-centre."""
    for person in people:
        vertices = _all_vertices(person)
        assert vertices[:, 1].min() == pytest.approx(0.0, abs=1e-5)
        assert 0.0 < person.body_vertices[:, 1].min() < 0.04
        middle = 0.5 * (person.body_vertices.min(0) + person.body_vertices.max(0))
        # Centred before the yaw: outstretched limbs make it more.
        off, tall = (0.2, 1.1) if person.name.startswith("active") else (0.12, 1.35)
        assert np.abs(middle[[0, 2]]).max() < off
        assert np.ptp(person.body_vertices[:, 1]) < 2.4
        assert person.body_vertices[:, 1].max() > tall


def test_faces_forward_within_the_yaw(people):
    """Feet point to +z, so that the first camera sees the front."""
    body = load_body()
    eyes = np.unique(body.surfaces["eyes"].quads)
    assert eyes.min() >= BODY_VERTICES
    toes = body.weights[:BODY_VERTICES, [body.bone("toe2-1.L"), body.bone("toe2-1.R")]].sum(1) > 0.9
    heels = body.weights[:BODY_VERTICES, [body.bone("foot.L"), body.bone("foot.R")]].sum(1) > 0.9
    for person in people:
        forward = person.body_vertices[toes].mean(0) - person.body_vertices[heels].mean(0)
        assert np.degrees(np.arctan2(forward[0], forward[2])) == pytest.approx(0, abs=45)


def test_arrays_are_finite_and_in_their_types(people):
    """Meshes have the documented types and shapes, no NaN and no unused vertices."""
    for person in people:
        assert person.body_vertices.dtype == np.float32
        assert person.body_vertices.shape == (BODY_VERTICES, 3)
        for part in person.parts:
            assert (part.vertices.dtype, part.uv.dtype, part.faces.dtype, part.texture.dtype) == (
                np.float32, np.float32, np.int64, np.uint8,
            )  # fmt: skip
            assert np.isfinite(part.vertices).all()
            assert len(part.faces) > 0
            assert part.uv.min() >= 0
            assert part.uv.max() <= 1
            assert (np.unique(part.faces) == np.arange(len(part.vertices))).all()


def test_normals_point_outwards(people):
    """Faces are wound outwards: most rays inwards hit the body, most rays outwards miss it."""
    for person in people[:3]:
        body = trimesh.Trimesh(
            person.body_vertices, triangles(load_body().surfaces["body"].quads), process=False
        )
        centres, signs = [], []
        for part in person.parts:
            corners = part.vertices[part.faces].astype(np.float64)
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            area = np.linalg.norm(normal, axis=1)
            chosen = np.flatnonzero(area > 1e-8)[::37]
            centres.append(corners[chosen].mean(1))
            signs.append(normal[chosen] / area[chosen, None])
        centres, signs = np.concatenate(centres), np.concatenate(signs)
        hits = body.ray.intersects_any(centres - 0.004 * signs, -signs)  # inwards lies the body
        away = body.ray.intersects_any(centres + 0.004 * signs, signs)
        assert hits.mean() > 0.85
        assert away.mean() < 0.35


def test_clothes_cover_the_hips(people):
    """No bare hips: rays from 20 cm away hit cloth (or a hand in front of it) before skin."""
    body = load_body()
    height = body.mean[:BODY_VERTICES, 1]
    hips = np.flatnonzero(
        (height > CROTCH + 0.04) & (height < 0.93) & (np.abs(body.mean[:BODY_VERTICES, 0]) < 0.2)
    )
    faces = triangles(body.surfaces["body"].quads)
    for person in people:
        offsets = np.cumsum([0] + [len(part.vertices) for part in person.parts])
        joined = np.concatenate([part.faces + o for part, o in zip(person.parts, offsets[:-1], strict=True)])
        owner = np.repeat(np.arange(len(person.parts)), [len(part.faces) for part in person.parts])
        mesh = trimesh.Trimesh(_all_vertices(person), joined, process=False)
        normals = vertex_normals(person.body_vertices.astype(np.float64), faces)[hips]
        first = mesh.ray.intersects_first(person.body_vertices[hips] + 0.2 * normals, -normals)
        assert (first >= 0).all()
        assert (owner[first] == 0).mean() < 0.08  # part 0 is the skin


@pytest.mark.parametrize("active", [False, True])
def test_arms_stay_out_of_the_trunk(active):
    """Poses in which arms intersect the trunk are resampled."""
    body = load_body()
    faces = triangles(body.surfaces["body"].quads)
    depths = []
    for index in range(20):
        rng = np.random.default_rng(index)
        figure = pose_figure(body, body.sample_shape(rng)[0], rng, active)
        depths.append(arm_depth(figure.posed, faces))
    assert np.mean(np.array(depths) < 0.015) >= 0.9
    assert max(depths) < 0.04


def test_people_in_motion_spread_bend_and_cross_their_legs():
    """Poses that standing people never have: feet a leg's length apart, deep knees, crossed feet."""
    body = load_body()
    apart, along, across, high = [], [], [], []
    for active in (False, True):
        found = []
        for index in range(24):
            rng = np.random.default_rng(index)
            figure = pose_figure(body, body.sample_shape(rng)[0], rng, active)
            placed = np.einsum("bij,bj->bi", figure.transforms[:, :, :3], figure.joints)
            placed += figure.transforms[:, :, 3]
            left, right, root = (placed[body.bone(name)] for name in ("foot.L", "foot.R", "root"))
            leg = figure.joints[body.bone("upperleg01.L"), 1]
            found.append(((left - right)[[0, 2]], root[1] / leg))
        steps = np.array([step for step, _ in found])
        apart.append(np.linalg.norm(steps, axis=1).max())
        along.append(np.abs(steps[:, 1]).max())
        across.append(steps[:, 0].min())
        high.append(min(height for _, height in found))
    assert apart[1] > apart[0] + 0.1
    assert along[1] > along[0] + 0.1
    assert apart[1] > 0.7
    assert across[1] < 0.0 < across[0]
    assert high[1] < high[0] - 0.08


@pytest.mark.parametrize(("seed", "index", "key"), [(-1, 0, "seed"), (0, -1, "index")])
def test_negative_numbers_are_refused(seed, index, key):
    """The message contains the invalid number."""
    refused(key, lambda: generate(seed, index))


SQUARE = {
    "vertices": np.zeros((4, 3), np.float32),
    "faces": np.array([[0, 1, 2], [0, 2, 3]]),
    "uv": np.zeros((4, 2), np.float32),
    "texture": np.zeros((2, 2, 3), np.uint8),
}


@pytest.mark.parametrize(
    ("name", "array", "line"),
    [
        ("uv", np.zeros((3, 2)), "uv: expected an array 4x2; found 3x2"),
        ("faces", np.array([[0, 1, 4]]), "faces: expected indices"),
        ("texture", np.zeros((2, 2, 3)), r"texture: expected uint8 \[h, w, 3\]; found 'float64 \[2, 2, 3\]'"),
        ("vertices", np.full((4, 3), np.nan), "vertices: expected finite numbers"),
    ],
)
def test_textured_mesh_refuses_other_shapes(name, array, line):
    """Inconsistent arrays are rejected when the mesh is created, not when it is rendered."""
    TexturedMesh(**SQUARE)
    refused(line, lambda: TexturedMesh(**{**SQUARE, name: array}))


# ---- mesh operations


def test_clip_keeps_the_area_on_its_side():
    """Garments are cut where their field is zero: both sides add up to the area, no face is flipped."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9)), -1).reshape(-1, 2)
    index = np.arange(81).reshape(9, 9)
    quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], -1).reshape(-1, 4)
    faces = triangles(quads)
    normal, offset = rng.normal(size=2), 0.1
    for sign in (1, -1):
        field = sign * ((grid - 0.5) @ normal - offset)
        kept, a, b, t = clip(faces, field)
        points = (1 - t)[:, None] * grid[a] + t[:, None] * grid[b]
        assert (sign * ((points - 0.5) @ normal - offset) > -1e-12).all()
        one, two, three = (points[kept[:, i]] for i in range(3))
        area = 0.5 * ((two - one)[:, 0] * (three - one)[:, 1] - (two - one)[:, 1] * (three - one)[:, 0])
        assert (area > -1e-12).all()  # no face is turned over
        if sign > 0:
            positive = area.sum()
        else:
            assert positive + area.sum() == pytest.approx(1.0)


def test_subdivision_and_smoothing_keep_a_plane():
    """Finer charts keep the outline, and are flat where the base mesh is flat."""
    quads = np.array([[0, 1, 4, 3], [1, 2, 5, 4]])
    points = np.array([[0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 1.0]])
    operator, fine = subdivide(quads, 6)
    assert fine.shape == (8, 4)
    assert operator.shape == (15, 6)
    np.testing.assert_allclose(operator.sum(1), 1.0)
    smooth = neighbour_mean(fine, 15)
    np.testing.assert_allclose(np.asarray(smooth.sum(1)).ravel(), 1.0)
    moved = smooth @ (operator @ points)
    np.testing.assert_allclose(moved.min(0), [0, 0], atol=1e-12)
    np.testing.assert_allclose(moved.max(0), [2, 1], atol=1e-12)


def test_rasterise_finds_the_place_of_texels():
    """Each texel is painted for its own position, not for one half a texel away."""
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    texels, face, bary, nearest = rasterise(uv, faces, 6, 4)
    assert len(texels) == 24
    np.testing.assert_array_equal(nearest, np.arange(24))
    place = np.einsum("kc,kci->ki", bary, uv[faces[face]])
    np.testing.assert_allclose(place[:, 0], (texels % 4 + 0.5) / 4, atol=1e-9)
    np.testing.assert_allclose(place[:, 1], 1 - (texels // 4 + 0.5) / 6, atol=1e-9)


def test_normals_of_a_sphere():
    """Normals, along which clothes are moved, have unit length, point outwards and weight faces by area."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    normals = vertex_normals(np.asarray(sphere.vertices), np.asarray(sphere.faces))
    assert (np.einsum("ni,ni->n", normals, sphere.vertices) > 0.999).all()
    roof = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 3.0]]
    )  # faces of areas 1/2 and 3/2 at right angles
    normals = vertex_normals(roof, np.array([[0, 1, 2], [0, 3, 1]]))
    np.testing.assert_allclose(normals[:2], np.tile(np.array([0, 3, 1]) / np.sqrt(10), (2, 1)))


def test_noise_has_no_seam_and_unit_variance():
    """Patterns repeat without a visible seam and keep their strength."""
    noise = Noise(np.random.default_rng(3), 1.3, 2.0)
    u = np.linspace(0, 1, 50)
    np.testing.assert_allclose(noise(u, u + 1), noise(u + 2, u), atol=2e-3)
    assert noise.field.std() == pytest.approx(1.0, abs=1e-4)
    assert abs(noise.field.mean()) < 1e-3
