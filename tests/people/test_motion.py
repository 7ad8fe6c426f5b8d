"""People in motion: what moves, what stays, and how they are rendered."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from benchmarks import moving_people as motion
from ghgs_people import figures
from ghgs_people.figures.body import load_body
from ghgs_people.figures.mesh import Person
from ghgs_people.jobs import RenderOptions
from ghgs_people.rig import Rig
from tests.helpers.people import box_person

INSTANTS, STEP = 3, 0.1
INDEX = 2_000_015  # walks, in trousers and with hair


@pytest.fixture(scope="module")
def moving():
    return motion.generate_moving(0, INDEX, INSTANTS)


@pytest.fixture
def boxes(monkeypatch):
    """Boxes that move to the left in place of people."""

    def generate(seed, index, instants, active=False):
        box = box_person(f"p{index}")
        vertices, faces = box.parts[0].vertices, box.parts[0].faces
        for _ in range(4):  # points are vertices: some must lie inside the faces of the box
            vertices, faces = trimesh.remesh.subdivide(vertices, faces)
        uv = np.full((len(vertices), 2), 0.5, np.float32)
        part = replace(box.parts[0], vertices=vertices.astype(np.float32), faces=faces, uv=uv)
        box = replace(box, parts=(part,))
        moved = [box.mapped(lambda v, i=i: v + np.array([STEP * i, 0, 0])) for i in range(instants)]
        parts = tuple(person.parts[0] for person in moved)
        return Person(box.name, parts, np.concatenate([person.body_vertices for person in moved]))

    monkeypatch.setattr(motion, "generate_moving", generate)


def test_the_first_instant_is_the_person_who_stands_still(moving):
    """Vertices, textures and body are equal."""
    still = figures.generate(0, INDEX)
    assert len(still.parts) * INSTANTS == len(moving.parts)
    for one, other in zip(still.parts, moving.parts, strict=False):
        for name in ("vertices", "faces", "uv", "texture"):
            assert np.array_equal(getattr(one, name), getattr(other, name))
    assert np.array_equal(still.body_vertices, moving.body_vertices[: len(still.body_vertices)])


def test_only_vertices_move(moving):
    """A part is the same surface at each instant; the fastest hand makes a few metres a second."""
    count = len(moving.parts) // INSTANTS
    for one, other in zip(moving.parts, moving.parts[count:], strict=False):
        assert other.texture is one.texture
        assert other.faces is one.faces
        assert other.uv is one.uv
        assert 0 < np.linalg.norm(one.vertices - other.vertices, axis=1).max() < 8 / motion.PASSAGE


def test_the_way_there_and_back_is_even_but_at_the_poses():
    shares = motion.shares(61)
    assert shares[[0, 15, 30, 60]] == pytest.approx([0, 0.5, 1, 0], abs=1e-12)
    steps = np.abs(np.diff(shares))
    assert steps[4:26].max() < 1.2 * steps[4:26].min()
    assert steps[0] < 0.5 * steps[15]


@pytest.mark.parametrize("index", [INDEX, 2_000_002])
def test_one_foot_stays_and_the_lower_one_is_on_the_ground(index):
    body = load_body()
    rng = np.random.default_rng(index)
    coefficients, _, _ = body.sample_shape(rng)
    first, second = (motion.pose_figure(body, coefficients, rng) for _ in range(2))
    moved = motion.Motion(body, first, second)
    figures = [moved.at(share) for share in (0.0, 0.3, 1.0)]
    assert figures[0].posed == pytest.approx(first.posed, abs=1e-9)
    balls = np.array([moved._feet(figure.transforms) for figure in figures])
    slid = np.ptp(balls[..., [0, 2]], axis=0).max(1)
    assert slid.min() < 1e-9 < 0.01 < slid.max()
    lowest = [f.posed[:, 1].min() for f in figures]
    assert np.ptp(lowest) < 1e-9
    # The last is the second pose, somewhere else.
    shift = figures[2].posed - second.posed
    assert np.ptp(shift, axis=0).max() < 1e-9


def test_each_instant_is_a_subject_before_the_same_cameras(boxes):
    """In their order; the points of the surface move as the box does, and lie on it."""
    settings = RenderOptions(size=56, samples=1, positions=(0, 4, 8, 12), views=(0, 3))
    reader = motion.MovingPerson("p2000015", INSTANTS, Rig(height=None), settings)
    assert list(reader.subjects) == [f"p2000015_t00{instant}" for instant in range(INSTANTS)]
    assert set(reader.subjects.values()) == {(0, 4, 8, 12)}
    points = list(reader.surfaces.values())
    first = reader.read_view("p2000015_t000", 4, 3, depth=True)
    for number, name in enumerate(reader.subjects):
        view = reader.read_view(name, 4, 3, depth=True)
        assert (view.extrinsics == first.extrinsics).all()
        assert view.mask.any()
        assert points[number] - points[0] == pytest.approx(
            np.tile([STEP * number, 0, 0], (4000, 1)), abs=1e-6
        )
    # The rig is around the whole motion.
    ends = np.concatenate([points[0], points[-1]])
    assert ends.min(0)[0] == pytest.approx(-ends.max(0)[0], abs=1e-6)
