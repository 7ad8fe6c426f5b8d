"""Rigs that vary between subjects and cameras: limits, framing, and no change without variation."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from ghgs_lit.data.layout import Layout
from ghgs_lit.data.sampling import subject_rng
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.projection import project
from ghgs_people.jobs import RenderOptions, identity
from ghgs_people.rig import Rig, RigOptions, Variation
from tests.helpers.people import RIG, box_person, render_boxes

VARIATION = Variation(
    radius=(1.6, 3.4), pitch=(-25, 8), fill=(0.55, 0.95), camera_pitch=6, camera_roll=8, camera_look_at=0.08
)
VARIED = Rig(height=None, variation=VARIATION)


def drawn(rig, person, aspect=1.0, seed=0):
    """A subject's rig, its cameras [16, 5] of 100 rows, and the yaws."""
    rng = subject_rng(seed, person.name)
    yaws = rig.yaws(rng)
    own, poses = rig.vary(person, yaws, aspect, rng)
    return own, own.cameras(yaws, 100, round(100 * aspect), poses), yaws


@pytest.mark.parametrize("extents", [(0.5, 1.7, 0.3), (1.9, 1.7, 0.3), (0.4, 1.1, 0.3)])
@pytest.mark.parametrize("aspect", [1.0, 0.7])
def test_every_camera_of_a_varied_rig_sees_the_whole_subject(extents, aspect):
    """Adults, children and outstretched arms are within every image, as large as ``fill`` if they fit."""
    fills, radii, pitches = [], [], []
    for seed in range(8):
        person = VARIED.place(box_person(extents=extents), subject_rng(seed, "box"))
        rig, cameras, _ = drawn(VARIED, person, aspect, seed)
        vertices = torch.from_numpy(person.parts[0].vertices).double()
        cameras = cameras[:, :, None]
        places = vertices.expand(16, 5, -1, -1)
        pixels, z = project(places, cameras.intrinsics.double(), cameras.extrinsics.double())
        assert z.min() > 0.3
        assert pixels.min() > 0
        assert (pixels.amax((0, 1, 2)) < torch.tensor([cameras.width, cameras.height])).all()
        fill = (pixels[..., 1].amax(-1) - pixels[..., 1].amin(-1)).max().item() / 100
        ends = torch.stack((pixels.amin((0, 1, 2)), 100 * torch.tensor([aspect, 1]) - pixels.amax((0, 1, 2))))
        full = ends.min() < 1.01  # it reaches the margin of some image
        assert fill < 0.951
        assert fill > 0.549 or full
        fills.append(fill)
        radii.append(rig.radius)
        pitches.append(rig.pitch)
    assert 1.6 <= min(radii) < 2 < 3 < max(radii) <= 3.4
    assert -25 <= min(pitches) < -15 < 0 < max(pitches) <= 8
    if extents == (0.5, 1.7, 0.3) and aspect == 1:
        assert np.ptp(fills) > 0.15


def test_single_cameras_deviate_within_their_limits():
    """Pitch, roll and position of a camera relative to its ring; view 1 is still the next ring camera."""
    person = VARIED.place(box_person(), subject_rng(0, "box"))
    rig, cameras, yaws = drawn(VARIED, person)
    even = rig.cameras(yaws, 100, 100)
    turn = (cameras.extrinsics[..., :3, :3] @ even.extrinsics[..., :3, :3].mT).double()
    pitch = torch.rad2deg(torch.asin(turn[..., 1, 2])).abs()
    roll = torch.rad2deg(torch.atan2(turn[..., 0, 1], turn[..., 0, 0])).abs()
    assert 4 < pitch.max() < 6.1
    assert 6 < roll.max() < 8.1
    looked_at = cameras.centers + rig.radius * cameras.extrinsics[..., 2, :3]
    shift = (looked_at - torch.tensor(rig.look_at)).abs()
    assert 0.06 < shift.max() < 0.0801
    following = cameras.extrinsics[:, 0].roll(-1, 0)
    # Yaws of the last position and the first differ by a whole turn.
    torch.testing.assert_close(cameras.extrinsics[:, 1], following, atol=1e-6, rtol=0)
    torch.testing.assert_close(torch.linalg.det(turn), torch.ones_like(pitch), atol=1e-5, rtol=0)


def test_only_views_between_ring_cameras_stand_higher_or_lower():
    """Targets are at heights that no input has; nothing else in the rig changes."""
    person = VARIED.place(box_person(), subject_rng(0, "box"))
    higher = replace(VARIED, variation=VARIATION.replace(between_pitch=20))
    pitches = []
    for rig in (VARIED, higher):
        _, cameras, _ = drawn(rig, person)
        pitches.append(torch.rad2deg(torch.asin(-cameras.extrinsics[..., 2, 1].double())))
    change = pitches[1] - pitches[0]
    assert change[:, :2].abs().max() < 1e-4
    assert -20.1 < change[:, 2:].min() < -15
    assert 15 < change[:, 2:].max() < 20.1


def test_without_variation_nothing_changes():
    """The ring is the same bit for bit, and caches of this renderer version keep their names."""
    person = box_person()
    rig, cameras, yaws = drawn(Rig(), person)
    assert rig == Rig()
    even = Rig().cameras(yaws, 100, 100)
    assert torch.equal(cameras.extrinsics, even.extrinsics)
    assert torch.equal(cameras.intrinsics, even.intrinsics)

    def key(rig):
        settings = json.dumps(identity(rig, RenderOptions(), 0), sort_keys=True)
        return hashlib.sha256(settings.encode()).hexdigest()[:16]

    assert key(Rig()) == "1022d3811bfc9cb2"
    variations = [
        Rig(variation=Variation(**{name: value}))
        for name, value in (("radius", [2, 2]), ("camera_roll", 1.0))
    ]
    assert len({key(rig) for rig in [Rig(), *variations]}) == 3


def test_what_varies_changes_nothing_else(tmp_path):
    """A rolled camera keeps its position, with the same person in the same light."""
    readers = []
    for name, rig in (("even", RIG), ("rolled", replace(RIG, variation=Variation(camera_roll=20)))):
        render_boxes(tmp_path / name, tmp_path / "scans", train=1, val=1, rig=rig)
        readers.append(Layout(tmp_path / name, "train"))
    even, rolled = (reader.read_view("s0", 3, 0, False) for reader in readers)
    assert np.abs(even.extrinsics - rolled.extrinsics)[:2, :3].max() > 0.01
    centers = [-view.extrinsics[:3, :3].T @ view.extrinsics[:3, 3] for view in (even, rolled)]
    np.testing.assert_allclose(*centers, atol=1e-6)
    bodies = [reader.read_body("s0") for reader in readers]
    np.testing.assert_array_equal(*bodies)
    colors = [view.image[view.mask].mean(0) for view in (even, rolled)]
    np.testing.assert_allclose(*colors, atol=4)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"radius": [3, 2]}, r"radius: expected \[least, greatest\]; found \[3\.0, 2\.0\]"),
        (
            {"fill": [0.5, 1.2]},
            r"fill: expected a list of 2 values \(each a number > 0 and < 1\) or null; found \[0\.5, 1\.2\]",
        ),
        ({"pitch": [-95, 0]}, r"pitch: expected a list of 2 values \(each a number > -89 and < 89\)"),
        ({"camera_roll": -1}, r"camera_roll: expected a number >= 0 and <= 180; found -1"),
        ({"camera_rol": 1}, r"camera_rol: .*did you mean camera_roll"),
    ],
)
def test_impossible_variations_are_refused(values, message):
    """The message contains the key."""
    with pytest.raises(InputError, match=rf"^data\.rig\.variation\W{message}"):
        RigOptions(variation=values)


def test_a_ring_inside_the_subject_is_refused():
    """A camera with parts of the subject behind it cannot frame the subject."""
    rig = Rig(height=None, variation=Variation(radius=(0.2, 0.2), fill=(0.5, 0.9)))
    with pytest.raises(InputError, match=r"data\.rig\.radius: expected a ring farther from box"):
        drawn(rig, box_person(extents=(0.8, 1.7, 0.8)))
