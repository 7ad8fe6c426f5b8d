"""Poses on two feet within the limits of human joints: gestures for the arms, stances for the legs.

Arms are posed by forward kinematics: a direction of the upper arm, an elbow angle, and a direction of the
forearm; legs by inverse kinematics (:mod:`ghgs_people.figures.legs`). Directions are in the
person's frame: +x left, +y up, +z forward; for the right side x is mirrored.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from ghgs_people.figures.body import BodyModel, bone_transforms
from ghgs_people.figures.legs import BENT, pose_legs
from ghgs_people.figures.skeleton import Skeleton, frame

SPINE = ("spine05", "spine04", "spine03", "spine02", "spine01")
NECK = ("neck01", "neck02", "neck03", "head")
FINGERS = ("finger2", "finger3", "finger4", "finger5")

# Direction of the upper arm (x outwards), direction in which the elbow bends; then elbow, forearm
# twist and curl of the fingers as (mean, half range) in degrees. Directions need no unit length.
GESTURES = {
    "relaxed": ((0.20, -1.0, 0.00), (-0.25, 0.2, 1.0), (18, 9), (-35, 15), (28, 14)),
    "loose": ((0.34, -1.0, 0.10), (-0.35, 0.2, 1.0), (32, 14), (-25, 15), (30, 15)),
    "away": ((0.62, -1.0, 0.05), (-0.10, 0.1, 1.0), (22, 14), (-10, 25), (22, 14)),
    "akimbo": ((0.78, -0.85, -0.42), (-0.88, -0.25, 0.42), (88, 5), (20, 10), (45, 15)),
    "guard": ((0.38, -1.0, 0.18), (-0.35, 0.85, 0.85), (95, 18), (-10, 30), (60, 25)),
    "offer": ((0.36, -1.0, 0.25), (0.20, 0.35, 1.0), (72, 18), (55, 20), (18, 10)),
    "point": ((0.30, -0.15, 1.0), (0.0, 0.6, 0.9), (16, 9), (-20, 25), (40, 25)),
    "side": ((1.0, -0.15, 0.08), (0.1, 0.25, 1.0), (16, 10), (-10, 30), (18, 12)),
    "wave": ((1.0, -0.20, 0.12), (-0.05, 1.0, 0.25), (92, 20), (-30, 25), (14, 10)),
    "raised": ((0.55, 0.85, 0.14), (-0.10, 1.0, 0.25), (26, 16), (-20, 30), (22, 15)),
    "reach": ((0.42, 0.30, 0.95), (-0.1, 0.8, 0.6), (34, 14), (0, 30), (20, 12)),
    "overhead": ((0.85, 0.60, 0.20), (-0.85, 0.75, 0.0), (82, 22), (0, 30), (25, 15)),
    "folded": ((0.42, -0.85, 0.50), (-0.90, 0.30, 0.55), (98, 10), (10, 20), (30, 15)),
    "back": ((0.40, -0.75, -0.65), (0.0, -0.2, -1.0), (12, 8), (0, 30), (25, 15)),
}
EVERYDAY = ("relaxed", "relaxed", "loose", "loose", "away", "akimbo", "guard", "offer")
STRIKING = ("point", "side", "wave", "raised", "reach")
SPORT = (*STRIKING, "overhead", "folded", "back", "guard", "akimbo")
STANCES = ("stand", "contrapposto", "walk", "step", "crouch", "wide")


def sample_pose(
    body: BodyModel, joints: np.ndarray, rng: np.random.Generator, widen: float = 0.0, active: bool = False
) -> np.ndarray:
    """Sample a pose.

    Args:
        body: the base mesh.
        joints: [b, 3], joints of one shape at rest, metres.
        rng: samples everything.
        widen: how far the arms move away from the body, 0 to 1.
        active: sport or dance, with legs far apart, bent or crossed, instead of standing or walking.

    Returns:
        Transforms [b, 3, 4] of the bones from rest to the pose, the soles on y = 0.
    """
    if active:
        stance = str(rng.choice(list(BENT), p=(0.4, 0.3, 0.2, 0.1)))
    else:
        stance = str(rng.choice(STANCES, p=(0.24, 0.22, 0.22, 0.12, 0.08, 0.12)))
    local = np.tile(np.eye(3), (len(joints), 1, 1))
    pelvis = _bend_trunk(body, local, stance, rng)
    skeleton = Skeleton(body, joints, _compose(body.bone_parents, local))
    gestures = tuple(rng.choice(SPORT, 2)) if active else _gestures(stance, rng)
    stride = rng.uniform(0.25, 0.5) * rng.choice((-1, 1))  # of the left foot, in lengths of the leg
    for side, gesture in zip((1, -1), gestures, strict=True):
        _pose_arm(skeleton, side, gesture, widen, -stride * side if stance == "walk" else 0.0, rng)
    root = pose_legs(skeleton, pelvis, stance, stride, rng)
    return bone_transforms(body.bone_parents, joints, skeleton.rotations, root)


def _gestures(stance: str, rng: np.random.Generator) -> tuple[str, str]:
    """Choose gestures of the left and the right arm, the same for both half of the time."""
    if stance == "walk" and rng.random() < 0.7:
        return "loose", "loose"
    first = str(rng.choice(EVERYDAY if rng.random() < 0.7 else STRIKING))
    second = first if rng.random() < 0.5 else str(rng.choice(EVERYDAY))
    return (first, second) if rng.random() < 0.5 else (second, first)


def _bend_trunk(body: BodyModel, local: np.ndarray, stance: str, rng: np.random.Generator) -> np.ndarray:
    """Twist, lean and bend spine and neck.

    Args:
        body: the base mesh.
        local: [b, 3, 3] rotations relative to the parents, changed in place.
        stance: one of `STANCES` or `BENT`.
        rng: samples the angles.

    Returns:
        Rotation [3, 3] of the pelvis.
    """
    twist = rng.uniform(-22, 22)
    side = rng.uniform(-5, 5)
    lean = rng.uniform(-4, 7)
    tilt = 0.0
    if stance == "contrapposto":
        tilt = rng.uniform(3.5, 7.0) * rng.choice((-1, 1))
        side -= 1.3 * tilt
    elif stance == "crouch":
        lean += rng.uniform(10, 20)
    elif stance == "walk":
        twist *= 0.5
    elif stance in ("lunge", "squat"):
        lean = lean + rng.uniform(0, 18)
        side = 2 * side
    pelvis = Rotation.from_euler("zxy", [tilt, 0.35 * lean, 0.25 * twist], degrees=True).as_matrix()
    local[body.bone("root")] = pelvis
    nod = rng.uniform(-9, 9) - 0.6 * lean
    turn = rng.uniform(-30, 30) - 0.5 * twist
    roll = rng.uniform(-6, 6)
    for names, angles in ((SPINE, (side, 0.65 * lean, 0.75 * twist)), (NECK, (roll, nod, turn))):
        share = Rotation.from_euler("zxy", np.array(angles) / len(names), degrees=True).as_matrix()
        local[[body.bone(name) for name in names]] = share
    return pelvis


def _compose(parents: np.ndarray, local: np.ndarray) -> np.ndarray:
    """Convert relative rotations of bones to world axes.

    Args:
        parents: [b] int, -1 for the root; parents come before children.
        local: [b, 3, 3] rotations relative to the parents.

    Returns:
        [b, 3, 3].
    """
    rotations = local.copy()
    for bone, parent in enumerate(parents):
        if parent >= 0:
            rotations[bone] = rotations[parent] @ local[bone]
    return rotations


def _descendants(body: BodyModel, bone: str) -> list[int]:
    """A bone and all its descendants."""
    members = [body.bone(bone)]
    for child, parent in enumerate(body.bone_parents):
        if parent in members:
            members.append(child)
    return members


def _pose_arm(
    skeleton: Skeleton, side: int, gesture: str, widen: float, swing: float, rng: np.random.Generator
) -> None:
    """Rotate one arm, with its hand and the shoulder girdle.

    Args:
        skeleton: skeleton whose rotations are set.
        side: +1: left, -1: right.
        gesture: one of `GESTURES`.
        widen: how far the arm moves away from the body, 0 to 1.
        swing: swing of the upper arm when walking, positive forward, about -0.5 to 0.5.
        rng: samples the angles.
    """
    end = ".L" if side > 0 else ".R"
    mirror = np.array([side, 1.0, 1.0])
    upper, bend, elbow, forearm, curl = GESTURES[gesture]
    chest = skeleton.rotations[skeleton.body.bone("spine01")]
    upper = np.array(upper) + rng.normal(0, 0.07, 3) + np.array([0.55 * widen, 0, 0.9 * swing])
    upper = upper / np.linalg.norm(upper)
    flex, twist, curl = (
        np.radians(mean + half * rng.uniform(-1, 1)) for mean, half in (elbow, forearm, curl)
    )
    bend = np.array(bend) + rng.normal(0, 0.08, 3)
    bend = bend - (bend @ upper) * upper
    lower = np.cos(flex) * upper + np.sin(flex) * bend / np.linalg.norm(bend)
    upper = chest @ (mirror * upper)
    lower = chest @ (mirror * lower)

    # The shoulder girdle follows a raised arm.
    lift = np.radians(np.interp(upper @ chest[:, 1], [-0.6, 0.0, 0.9], [0.0, 6.0, 24.0])) * side
    girdle = Rotation.from_rotvec(chest @ np.array([0, 0, lift])).as_matrix() @ chest
    for name, weight in (("clavicle", 0.6), ("shoulder01", 1.0)):
        skeleton.rotate(name + end, chest @ _fraction(chest.T @ girdle, weight))

    shoulder, elbow_at, wrist = skeleton.rest("upperarm01", "lowerarm01", "wrist", end=end)
    hinge_rest = np.cross(elbow_at - shoulder, wrist - elbow_at)
    hinge = np.cross(upper, lower)
    full = frame(upper, hinge) @ frame(elbow_at - shoulder, hinge_rest).T
    swung = _shortest(girdle @ (elbow_at - shoulder), upper) @ girdle
    skeleton.rotate("upperarm01" + end, swung @ _fraction(swung.T @ full, 0.5))
    skeleton.rotate("upperarm02" + end, full)
    fore = frame(lower, hinge) @ frame(wrist - elbow_at, hinge_rest).T
    pronate = Rotation.from_rotvec(lower * twist * side).as_matrix()
    skeleton.rotate("lowerarm01" + end, fore)
    skeleton.rotate("lowerarm02" + end, _fraction(pronate, 0.5) @ fore)
    _pose_hand(skeleton, end, pronate @ fore, curl, rng)


def _pose_hand(skeleton: Skeleton, end: str, hand: np.ndarray, curl: float, rng: np.random.Generator) -> None:
    """Bend the wrist a little and curl the fingers.

    Args:
        skeleton: skeleton whose rotations are set.
        end: ``.L`` or ``.R``.
        hand: rotation [3, 3] of the straight hand in world axes.
        curl: curl of the fingers, radians.
        rng: samples small deviations.
    """
    index, little = skeleton.rest("finger2-1", "finger5-1", end=end)
    across = (index - little) / np.linalg.norm(index - little)
    rest_curl = 0.0
    for finger in FINGERS:
        one, two, three = skeleton.rest(f"{finger}-1", f"{finger}-2", f"{finger}-3", end=end)
        rest_curl += np.cross(across, two - one) @ (three - two)
    across *= np.sign(rest_curl)
    hand = hand @ Rotation.from_rotvec(across * rng.uniform(-0.2, 0.2)).as_matrix()
    skeleton.rotations[_descendants(skeleton.body, "wrist" + end)] = hand
    along = {}
    for finger in (*FINGERS, "finger1"):
        one, two = skeleton.rest(f"{finger}-1", f"{finger}-2", end=end)
        along[finger] = (two - one) / np.linalg.norm(two - one)
    middle = np.mean([along[finger] for finger in FINGERS], 0)
    close = rng.uniform(0.2, 0.9)  # the hand is spread at rest
    for number, finger in enumerate(FINGERS):
        amount = curl * (0.75 + 0.14 * number) + rng.uniform(-0.06, 0.06)
        sideways = _shortest(along[finger], (1 - close) * along[finger] + close * middle)
        for joint, share in enumerate((0.55, 1.35, 1.7), start=1):
            turn = Rotation.from_rotvec(across * amount * share).as_matrix()
            skeleton.rotate(f"{finger}-{joint}{end}", hand @ turn @ sideways)
    thumb = hand @ _shortest(along["finger1"], along["finger1"] + 0.5 * close * middle)
    for joint in (1, 2, 3):
        skeleton.rotate(f"finger1-{joint}{end}", thumb)


def _fraction(rotation: np.ndarray, share: float) -> np.ndarray:
    """Scale the angle of a rotation [3, 3] by a factor."""
    return Rotation.from_rotvec(share * Rotation.from_matrix(rotation).as_rotvec()).as_matrix()


def _shortest(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Smallest rotation [3, 3] from direction `start` to `end`."""
    axis = np.cross(start, end)
    sine = np.linalg.norm(axis)
    angle = np.arctan2(sine, start @ end)
    return Rotation.from_rotvec(axis * (angle / max(sine, 1e-12))).as_matrix()
