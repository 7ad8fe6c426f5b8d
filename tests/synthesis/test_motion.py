"""People in motion: what moves, what stays, and how they are rendered and read."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.measure import Estimate, measure_all
from ghgs_lit.metrics import MetricsOptions
from ghgs_lit.synthesis import motion, people
from ghgs_lit.synthesis.datasets import Synthetic
from ghgs_lit.synthesis.people.body import load_body
from ghgs_lit.synthesis.people.mesh import Person
from tests.helpers.people import V4, box_person

INSTANTS, STEP = 3, 0.1
RELEASE = {"name": "release", "training_views": (3,)}
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


def built(tmp_path, **changes):
    arguments = {
        "people": {"train": 1, "val": 2},
        "motion": INSTANTS,
        "size": 56,
        "render": {"size": 56, "samples": 1, "positions": (0, 4, 8, 12), "views": (0, 3)},
        "cache_dir": str(tmp_path),
        "render_workers": 0,
    }
    return Synthetic(**(arguments | changes)).build(V4, RELEASE)


def test_the_first_instant_is_the_person_who_stands_still(moving):
    """Vertices, textures and body are equal."""
    still = people.generate(0, INDEX)
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


def test_each_instant_is_a_subject_before_the_same_cameras(tmp_path, boxes):
    """In their order; the points of the surface move as the box does, and lie on it."""
    data = built(tmp_path)
    data.prepare_data()
    subjects = list(data.subjects("val"))
    assert subjects == [f"p100000{person}_t00{instant}" for person in range(2) for instant in range(INSTANTS)]
    found = [data.evaluation_batch(name, targets=RELEASE) for name in subjects[:INSTANTS]]
    reader = data.builder("val").inputs.reader
    points = [reader.read_surface(name) for name in subjects[:INSTANTS]]
    for number, batch in enumerate(found):
        assert (batch.cameras.extrinsics == found[0].cameras.extrinsics).all()
        assert points[number] - points[0] == pytest.approx(
            np.tile([STEP * number, 0, 0], (4000, 1)), abs=1e-6
        )
    # The rig is around the whole motion.
    ends = np.concatenate([points[0], points[-1]])
    assert ends.min(0)[0] == pytest.approx(-ends.max(0)[0], abs=1e-6)
    image = data.dataset.folder / "val" / "img" / "p1000000_t001_000"
    assert {path.suffix for path in image.iterdir()} == {".png"}


def test_a_rendering_that_was_killed_goes_on_with_whole_sequences(tmp_path, boxes):
    data = built(tmp_path)
    data.prepare_data()
    marker = data.dataset.folder / "rendering" / "done" / "val" / "p1000001_t002"
    marker.unlink()
    with pytest.raises(InputError, match="p1000001_t002 is missing or half-rendered"):
        built(tmp_path).subjects("val")
    again = built(tmp_path)
    again.prepare_data()
    assert marker.exists()
    assert len(again.subjects("val")) == 2 * INSTANTS


def test_an_evaluation_has_the_flicker_of_each_instant_but_the_first(tmp_path, boxes):
    """An error that alternates between instants, and one that stays; each person is a sequence."""
    data = built(tmp_path)
    data.prepare_data()

    def alternating(batch):
        odd = int(batch.subjects[0][-1]) % 2
        return Estimate((0.5 + 0.2 * odd) * batch.targets.images)

    methods = {"alternating": alternating, "dark": lambda batch: Estimate(0.5 * batch.targets.images)}
    rows = measure_all(methods, data, [4], {"release": RELEASE}, "val", MetricsOptions(lpips="off").build())
    flickers = {name: [row.get("flicker") for row in rows if row["method"] == name] for name in methods}
    for person in range(2):
        first, *later = flickers["alternating"][INSTANTS * person : INSTANTS * (person + 1)]
        assert first is None
        # 0.2 of the colours (200, 90, 30), in lights of 0.3 to 1
        assert all(0.3 * 0.2 * 107 / 255 < value < 0.2 * 107 / 255 for value in later)
    steady = [value for value in flickers["dark"] if value is not None]
    assert len(steady) == 2 * (INSTANTS - 1)
    assert max(steady) < 0.005


def test_the_frozen_people_stand_still(tmp_path):
    """They are not among the splits of people in motion."""
    with pytest.raises(InputError, match=r"split: expected one of train, val; found 'bench'"):
        built(tmp_path).prepare_data(["bench"])
