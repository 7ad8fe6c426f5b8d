"""People in the cameras of a capture: the right places,
whatever the calibration's world and unit."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ghgs_lit.errors import InputError
from ghgs_people.capture_rig import SHARE, CaptureRig, RigCamera
from ghgs_people.rig import Rig
from tests.helpers.people import box_person

YAWS = np.array([20.0, 100.0, 190.0, 300.0])
FILL = (0.7, 0.7)
UNTURNED = np.eye(3)


def ring(yaws=YAWS, turn=UNTURNED, shift=(0, 0, 0), unit=1.0, pitch=-20.0):
    """Cameras of a ring in a world of another direction, origin and unit."""
    cameras = Rig(pitch=pitch).cameras(np.asarray(yaws), 480, 640)
    poses = cameras.extrinsics.double().numpy().copy()
    poses[:, :3, 3] = unit * (poses[:, :3, 3] - poses[:, :3, :3] @ np.asarray(shift))
    poses[:, :3, :3] = poses[:, :3, :3] @ turn.T
    return [
        RigCamera(intrinsics=k.tolist(), extrinsics=e.tolist(), width=640, height=480)
        for k, e in zip(cameras.intrinsics.double().numpy(), poses, strict=True)
    ]


def placed(cameras, seed=0):
    """The cameras [4, 5] of crops of 140 x 98 around a person, and the person."""
    rng = np.random.default_rng(seed)
    rig = CaptureRig.of(cameras, FILL)
    person = rig.place(box_person(extents=(0.5, 1.7, 0.3)), rng)
    places = rig.yaws(rng)
    own, poses = rig.drawn(person, places, 0.7, rng)
    crops = [own.cameras(places[i], 140, 98, poses[i]) for i in range(rig.positions)]
    return crops, person.parts[0].vertices, places


def test_the_world_of_the_calibration_does_not_matter():
    """A turned, shifted world in millimetres gives the same crops;
    cameras are sorted by azimuth."""
    crops, _, _ = placed(ring())
    turn = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
    others, _, _ = placed([ring(turn=turn, shift=(30.0, -8.0, 100.0), unit=1000.0)[i] for i in (2, 0, 3, 1)])

    def centers(found):
        poses = np.stack([c.extrinsics.numpy() for c in found]).astype(np.float64)
        return -(poses[..., :3, :3].swapaxes(-1, -2) @ poses[..., :3, 3:])[..., 0]

    # Azimuth zero is anywhere: distances between cameras and people are what must agree.
    one, other = (centers(found)[:, 0] for found in (crops, others))
    gaps = [np.linalg.norm(np.roll(c, 1, 0) - c, axis=-1) for c in (one, other)]
    assert np.allclose(sorted(gaps[0]), sorted(gaps[1]), atol=1e-3)
    assert np.allclose(one[:, 1], other[:, 1], atol=1e-3)
    focal = [np.sort(np.stack([c.intrinsics.numpy()[0, 1, 1] for c in found])) for found in (crops, others)]
    assert np.allclose(*focal, rtol=0.15)  # the person stands and faces elsewhere


def test_cameras_keep_their_places_beside_one_another():
    """Angles between the directions from the subject to the cameras, and what is up."""
    rig = CaptureRig.of(ring(), FILL)
    assert np.allclose(rig._middle, [0, 0.85, 0], atol=1e-4)
    assert np.allclose(rig._upright[1], [0, 1, 0], atol=1e-6)
    crops, _, _ = placed(ring())
    poses = np.stack([c.extrinsics[0].double().numpy() for c in crops])
    across = poses[:, 2, :3] @ poses[:, 2, :3].T
    given = np.stack([np.asarray(c.extrinsics)[2, :3] for c in ring()])
    assert np.allclose(np.sort(across, None), np.sort(given @ given.T, None), atol=1e-5)


def test_views_between_cameras_turn_about_the_subject():
    """View 3 is half-way in azimuth, at the mean distance and height,
    and looks at the same place."""
    crops, _, _ = placed(ring())
    for i, crop in enumerate(crops):
        first, then, middle = (crop.extrinsics[n].double().numpy() for n in (0, 1, 3))
        assert np.allclose(then, crops[(i + 1) % 4].extrinsics[0].numpy(), atol=1e-5)
        mean = first[2, :3] + then[2, :3]
        mean[1] = 0
        axis = middle[2, :3] * [1, 0, 1]
        wide = np.degrees(np.arccos(np.clip(first[2, :3] @ then[2, :3], -1, 1))) > 170
        assert wide or np.allclose(mean / np.linalg.norm(mean), axis / np.linalg.norm(axis), atol=1e-4)
        assert np.isclose(middle[2, 1], first[2, 1], atol=1e-4)


def test_every_crop_holds_the_whole_subject():
    """As crops of photographs do: 0.8 of the tighter side, in the middle."""
    crops, vertices, _ = placed(ring())
    for crop in crops:
        for matrix, pose in zip(crop.intrinsics.numpy(), crop.extrinsics.numpy(), strict=True):
            pixels = (vertices @ pose[:3, :3].T + pose[:3, 3]) @ matrix.T
            pixels = pixels[:, :2] / pixels[:, 2:]
            extent = np.ptp(pixels, axis=0) / [98, 140]
            assert np.isclose(extent.max(), SHARE, atol=1e-3)
            assert np.allclose((pixels.min(0) + pixels.max(0)) / 2, [49, 70], atol=0.05)


def test_distance_follows_from_how_much_of_the_photograph_the_subject_takes():
    """A subject that takes half as much stands twice as far."""
    person, rng = box_person(extents=(0.5, 1.7, 0.3)), np.random.default_rng(0)
    near = CaptureRig.of(ring(), FILL)
    scales = []
    for rig in (near, replace(near, fill=(0.35, 0.35))):
        scales.append(rig.drawn(person, rig.yaws(rng), 1.0, rng)[0].scale)
    assert np.isclose(scales[1], 2 * scales[0])


def outwards():
    """Cameras whose backs are turned to the subject."""
    poses = [np.diag([-1.0, 1.0, -1.0, 1.0]) @ np.asarray(camera.extrinsics) for camera in ring()]
    return [c.model_copy(update={"extrinsics": pose}) for c, pose in zip(ring(), poses, strict=True)]


@pytest.mark.parametrize(
    ("cameras", "expected"),
    [
        (ring()[:1], "two or more cameras; found 1"),
        ([ring()[0], ring()[0]], "several directions"),
        (outwards(), "look at one place"),
    ],
)
def test_rigs_that_surround_nobody_are_refused(cameras, expected):
    with pytest.raises(InputError, match=expected):
        CaptureRig.of(cameras, FILL)
