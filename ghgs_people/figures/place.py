"""Places on the body: coordinates on the average body at rest, in which clothes and faces are described.

Patterns, seams, hems and necklines are functions of the place, so they are the same for every shape.
"""

from dataclasses import dataclass

import numpy as np

from ghgs_people.figures.blending import smoothstep
from ghgs_people.figures.body import load_body

CROTCH = 0.766  # height of the average body's crotch, metres
# centre of the left eye in the frame that faces are described in
EYE = np.array([0.0288, 1.5661, 0.1909])


@dataclass(frozen=True)
class Place:
    """Coordinates of n points on the average body at rest, float32."""

    point: np.ndarray  # [n, 3] metres
    arm: np.ndarray  # [n] 0 on the trunk, 1 on an arm, smooth between
    sleeve: np.ndarray  # [n] metres from the shoulder joint along the arm; at most 0 on the trunk
    side: np.ndarray  # [n] +1 left, -1 right
    trunk_angle: np.ndarray  # [n] radians around the trunk, 0 in front, positive to the left
    arm_angle: np.ndarray  # [n] radians around the arm, 0 in front, positive outwards
    leg_angle: np.ndarray  # [n] radians around the leg, 0 in front, positive outwards

    @property
    def x(self) -> np.ndarray:
        return self.point[:, 0]

    @property
    def y(self) -> np.ndarray:
        return self.point[:, 1]

    @property
    def z(self) -> np.ndarray:
        return self.point[:, 2]


def locate(point: np.ndarray, arm_weight: np.ndarray) -> Place:
    """Compute the places of points on the average body.

    Args:
        point: [n, 3], metres, on the average body at rest.
        arm_weight: [n] sum of their skinning weights of the arm bones, 0 to 1.
    """
    body = load_body()
    joints = body.mean[body.vertex_count :]
    side = np.where(point[:, 0] >= 0, 1.0, -1.0)
    folded = point * np.stack([side, np.ones_like(side), np.ones_like(side)], 1)
    arm = smoothstep(0.1, 0.55, arm_weight)
    along, radial = _along(
        folded, [joints[body.bone(n + ".L")] for n in ("upperarm01", "lowerarm01", "wrist")]
    )
    sleeve = np.where(arm_weight > 0.02, along * arm, np.minimum(along, 0.0))
    arm_angle = np.arctan2(radial @ [0.74, 0.67, 0.0], radial @ [0.0, 0.0, 1.0])
    legs = np.array([joints[body.bone(n + ".L")] for n in ("upperleg01", "lowerleg01", "foot")])
    centre = np.stack([np.interp(-folded[:, 1], -legs[:, 1], legs[:, i]) for i in (0, 2)], 1)
    # Above the legs, the angle is around the centre of each half of the trunk.
    centre[:, 0] += smoothstep(CROTCH - 0.1, 0.95, folded[:, 1]) * (0.09 - centre[:, 0])
    leg_angle = np.arctan2(folded[:, 0] - centre[:, 0], folded[:, 2] - centre[:, 1])
    trunk_angle = np.arctan2(point[:, 0] / 1.45, point[:, 2] - 0.09)
    values = (point, arm, sleeve, side, trunk_angle, arm_angle, leg_angle)
    return Place(*(value.astype(np.float32) for value in values))


def _along(points: np.ndarray, line: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates along a polyline whose ends are extended straight.

    Args:
        points: [n, 3], metres.
        line: vertices of the polyline, each [3], metres.

    Returns:
        Length [n] along the line from its first joint, and offset [n, 3] from it.
    """
    starts = np.array(line[:-1])  # [s, 3]
    steps = np.diff(line, axis=0)  # [s, 3]
    lengths = np.linalg.norm(steps, axis=1)
    directions = steps / lengths[:, None]
    low = np.zeros(len(steps))
    high = lengths.copy()
    low[0] = -np.inf
    high[-1] = np.inf
    from_start = points[:, None] - starts
    along = np.clip(np.einsum("nsi,si->ns", from_start, directions), low, high)
    offset = from_start - along[..., None] * directions
    nearest = np.linalg.norm(offset, axis=-1).argmin(1)
    rows = np.arange(len(points))
    return along[rows, nearest] + (np.cumsum(lengths) - lengths)[nearest], offset[rows, nearest]


def face_frame(point: np.ndarray) -> np.ndarray:
    """Move points so that the left eye is at `EYE` in y and z.

    Args:
        point: [n, 3] of the average head, metres.

    Returns:
        [n, 3], metres.
    """
    body = load_body()
    eyes = body.mean[np.unique(body.surfaces["eyes"].quads)]
    return point + (EYE - eyes[eyes[:, 0] > 0].mean(0)) * [0, 1, 1]


def hairline(point: np.ndarray) -> np.ndarray:
    """Height above the hairline.

    Args:
        point: [n, 3] of the average head, metres.

    Returns:
        Metres [n], positive on the scalp.
    """
    point = face_frame(point)
    angle = np.degrees(np.arctan2(np.abs(point[:, 0]), point[:, 2] - 0.105))
    line = np.interp(
        angle,
        [0, 25, 42, 55, 66, 78, 88, 100, 118, 135, 155, 180],
        [1.634, 1.632, 1.622, 1.600, 1.572, 1.552, 1.566, 1.586, 1.556, 1.520, 1.492, 1.486],
    )
    return point[:, 1] - line
