"""Pose legs by inverse kinematics: soles are placed on the ground and knees follow, so feet do not
float."""

import numpy as np
from scipy.spatial.transform import Rotation

from ghgs_people.figures.skeleton import Skeleton, frame

#: Stances in motion, with the least and greatest fraction of its length to which a leg is bent
BENT = {"lunge": (0.62, 0.95), "squat": (0.45, 0.85), "cross": (0.98, 1.0), "crouch": (0.55, 0.8)}


def pose_legs(
    skeleton: Skeleton, pelvis: np.ndarray, stance: str, stride: float, rng: np.random.Generator
) -> np.ndarray:
    """Place the soles on the ground, and solve for hips and knees.

    Args:
        skeleton: skeleton whose rotations are set.
        pelvis: rotation [3, 3] of the pelvis.
        stance: one of `STANCES` or `BENT`.
        stride: how far the left foot is in front (behind where negative), in lengths of the leg.
        rng: samples the feet and the bend of the legs.

    Returns:
        Position of the root joint [3], metres.
    """
    (root,) = skeleton.rest("root")
    feet = _feet(skeleton, stance, stride, rng)
    ankles = []
    hips = []
    lengths = []
    for end, (across, forward, yaw, heel) in zip((".L", ".R"), feet, strict=True):
        hip, knee, ankle, toes = skeleton.rest("upperleg01", "lowerleg01", "foot", "toe2-1", end=end)
        turn = Rotation.from_euler("y", yaw, degrees=True).as_matrix()
        lifted = turn @ Rotation.from_euler("x", heel, degrees=True).as_matrix()
        ball = np.array([across, toes[1], forward]) + turn @ [0, 0, toes[2] - ankle[2]]
        ankles.append(ball + lifted @ (ankle - toes))
        hips.append(pelvis @ (hip - root))
        lengths.append((np.linalg.norm(knee - hip), np.linalg.norm(ankle - knee)))
        skeleton.rotate("foot" + end, lifted)
        skeleton.rotate("toe2-1" + end, turn)
    centre = np.mean(ankles, 0) - np.mean(hips, 0)
    if stance == "contrapposto":  # the leg with the higher hip carries the weight
        centre += 0.3 * (ankles[0] - ankles[1]) * (1 if hips[0][1] > hips[1][1] else -1)
    elif stance == "lunge":  # towards the foot in front
        centre += rng.uniform(0.0, 0.2) * (ankles[0] - ankles[1]) * np.sign(stride)
    bend = rng.uniform(*BENT[stance]) if stance in BENT else 1.0
    heights = []
    for ankle, hip, (thigh, shin) in zip(ankles, hips, lengths, strict=True):
        reach = 0.994 * (thigh + shin) * (bend**0.35)
        flat = ankle[[0, 2]] - (centre + hip)[[0, 2]]
        heights.append(ankle[1] + np.sqrt(reach**2 - flat @ flat) - hip[1])
    centre[1] = min(heights)
    for end, ankle, hip, (thigh, shin), foot in zip((".L", ".R"), ankles, hips, lengths, feet, strict=True):
        toward = Rotation.from_euler("y", 0.7 * foot[2], degrees=True).as_matrix() @ [0, 0, 1.0]
        _solve_leg(skeleton, end, centre + hip, ankle, (thigh, shin), toward)
    return centre


def _feet(
    skeleton: Skeleton, stance: str, stride: float, rng: np.random.Generator
) -> list[tuple[float, float, float, float]]:
    """Place the feet.

    Args:
        skeleton: provides the width of the hips and the length of the legs.
        stance: one of `STANCES` or `BENT`.
        stride: how far the left foot is in front (behind where negative), in lengths of the leg.
        rng: samples the deviations.

    Returns:
        For the left and the right foot: ankle position across and forward (metres), yaw and heel lift
        (degrees).
    """
    half, leg, _ = skeleton.rest("upperleg01.L")[0]
    half = half * rng.uniform(0.85, 1.25)
    feet = []
    for side in (1, -1):
        x = side * half
        z = rng.normal(0, 0.015)
        yaw = side * rng.uniform(2, 16)
        heel = 0.0
        if stance in ("walk", "step"):
            scale = 0.62 if stance == "walk" else 0.35
            x = side * half * 0.7
            z = scale * leg * stride * side
            heel = rng.uniform(14, 32) if z < 0 and stance == "walk" else 0.0
        elif stance in ("wide", "crouch"):
            x = side * half * rng.uniform(1.5, 2.1)
            yaw = side * rng.uniform(10, 26)
        elif stance == "lunge":
            x = side * half * 0.8
            z = 0.9 * leg * stride * side
            yaw = 0.6 * yaw
            heel = rng.uniform(18, 42) if z < 0 else 0.0
        elif stance == "squat":
            x = side * half * rng.uniform(2.0, 3.2)
            yaw = side * rng.uniform(20, 45)
        elif stance == "cross":
            x = -side * half * rng.uniform(0.0, 0.5)
            z = side * np.sign(stride) * rng.uniform(0.08, 0.14)
        elif stance == "contrapposto" and side * stride > 0:
            x = side * half * 1.35
            z = rng.uniform(0.03, 0.14)
            yaw = side * rng.uniform(14, 32)
        feet.append((x, z, yaw, heel))
    return feet


def _solve_leg(
    skeleton: Skeleton,
    end: str,
    hip: np.ndarray,
    ankle: np.ndarray,
    lengths: tuple[float, float],
    toward: np.ndarray,
) -> None:
    """Two-bone inverse kinematics by the law of cosines.

    Args:
        skeleton: skeleton whose rotations are set.
        end: ``.L`` or ``.R``.
        hip: hip joint [3] in the pose, metres.
        ankle: ankle joint [3] in the pose, metres.
        lengths: lengths of thigh and shin, metres.
        toward: direction [3] that the knee points to.
    """
    thigh, shin = lengths
    line = ankle - hip
    distance = min(np.linalg.norm(line), 0.999 * (thigh + shin))
    line /= np.linalg.norm(line)
    angle = np.arccos(np.clip((thigh**2 + distance**2 - shin**2) / (2 * thigh * distance), -1, 1))
    out = toward - (toward @ line) * line
    knee = hip + thigh * (np.cos(angle) * line + np.sin(angle) * out / np.linalg.norm(out))
    hinge = np.cross(toward, line)
    rest = skeleton.rest("upperleg01", "lowerleg01", "foot", end=end)
    axis = np.array([1.0, 0, 0])  # of the knees at rest
    upper = frame(knee - hip, hinge) @ frame(rest[1] - rest[0], axis).T
    lower = frame(ankle - knee, hinge) @ frame(rest[2] - rest[1], axis).T
    for name, rotation in (("upperleg", upper), ("lowerleg", lower)):
        skeleton.rotate(f"{name}01{end}", rotation)
        skeleton.rotate(f"{name}02{end}", rotation)
