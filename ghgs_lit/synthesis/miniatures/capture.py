"""What rigs of still cameras around a performer have in common: where cameras look, where people stand."""

from dataclasses import replace

import numpy as np

from ghgs_lit.synthesis.people.mesh import Person


def look_at(center: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """World to camera [4, 4] of an upright camera at ``center`` that looks at ``target`` (OpenCV axes)."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack((right, np.cross(forward, right), forward))
    pose[:3, 3] = -pose[:3, :3] @ center
    return pose


def ring(count: int, radius: float, height: float, rng: np.random.Generator) -> np.ndarray:
    """Centres [count, 3] of cameras around the y axis, in order, none of them quite where it should be."""
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(-0.15, 0.15, count)) / count
    radii = radius * rng.uniform(0.93, 1.07, count)
    heights = height + rng.uniform(-0.35, 0.35, count)
    return np.stack((radii * np.sin(angles), heights, radii * np.cos(angles)), -1)


def moved(person: Person, pose: np.ndarray) -> Person:
    """``person`` in another frame: ``pose`` [4, 4] maps old to new."""

    def move(vertices: np.ndarray) -> np.ndarray:
        return (vertices.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)

    parts = tuple(replace(part, vertices=move(part.vertices)) for part in person.parts)
    return replace(person, parts=parts, body_vertices=move(person.body_vertices))


def turned(degrees: float, shift: np.ndarray) -> np.ndarray:
    """[4, 4]: a turn about the y axis, then a ``shift`` [3]."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    pose = np.eye(4)
    pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    pose[:3, 3] = shift
    return pose


def studio_background(height: int, width: int, tint: float) -> np.ndarray:
    """[h, w, 3] uint8: a grey wall over a brown floor, so that a forgotten mask shows."""
    rows = np.linspace(0, 1, height)[:, None, None]
    wall = np.array([150, 155, 160]) * (0.8 + 0.3 * rows) * tint
    floor = np.array([120, 95, 70]) * (0.7 + 0.3 * rows)
    return np.broadcast_to(np.where(rows < 0.8, wall, floor), (height, width, 3)).astype(np.uint8).copy()
