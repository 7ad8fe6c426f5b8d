"""Mistakes of calibrations, as functions of a camera in the package's JSON format."""

import numpy as np

FLIP = np.diag([1.0, -1, -1, 1])


def pose(change):
    """A mistake in the pose of a camera."""
    return lambda c: {**c, "extrinsics": change(np.array(c["extrinsics"])).tolist()}


def lens(change):
    """A mistake in the intrinsics of a camera."""
    return lambda c: {**c, "intrinsics": change(np.array(c["intrinsics"]), c).tolist()}


def longer(factor):
    return pose(lambda e: np.block([[e[:3, :3], e[:3, 3:] * factor], [e[3:]]]))


def scaled(factor):
    return lens(lambda k, c: k * [[factor], [factor], [1]])


def turned(degrees):
    a = np.radians(degrees)
    turn = np.array([[np.cos(a), 0, np.sin(a), 0], [0, 1, 0, 0], [-np.sin(a), 0, np.cos(a), 0], [0, 0, 0, 1]])
    return pose(lambda e: turn @ e)


NORMALIZED = lens(lambda k, c: k / [[c["width"]], [c["height"]], [1]])
PRINCIPAL = lens(lambda k, c: k / [[1, 1, c["width"]], [1, 1, c["height"]], [1, 1, 1]])
SHIFTED = lens(lambda k, c: k + np.array([[0, 0, 0.1 * c["width"]], [0, 0, 0.05 * c["height"]], [0, 0, 0]]))
INVERSE, OPENGL = pose(np.linalg.inv), pose(lambda e: FLIP @ e)

# Mistakes of all cameras, with the option that corrects them.
ALL = {
    "inverse": (INVERSE, "calibration.extrinsics=camera_to_world"),
    "axes": (OPENGL, "calibration.axes=opengl"),
    "blender": (
        pose(lambda e: np.linalg.inv(e) @ FLIP),
        "calibration.extrinsics=camera_to_world calibration.axes=opengl",
    ),
    "normalized": (NORMALIZED, "calibration.intrinsics=normalized"),
    "normalized principal point": (PRINCIPAL, "calibration.intrinsics=normalized_principal"),
    "photographs halved": (scaled(2), "calibration.resized=0.5"),
    "inverse and photographs doubled": (
        lambda c: INVERSE(scaled(0.5)(c)),
        "calibration.extrinsics=camera_to_world calibration.resized=2",
    ),
}
# Mistakes of one camera of four.
ONE = {
    "inverse": INVERSE,
    "axes": OPENGL,
    "millimetres": longer(1000),
    "principal point": SHIFTED,
    "size": scaled(2),
    "turned by 6 degrees": turned(6),
    "other lens": scaled(1.3),
}
