"""Body model: shapes as principal components, a skeleton, linear blend skinning.

The asset holds MakeHuman data (CC0 1.0, see ``assets/LICENSE``), converted by
``scripts/bake_body.py``. Metres, y up, facing +z; the person's left is +x. At rest the feet stand
on y = 0 and the arms hang at 45 degrees from the body.
"""

from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import as_file, files

import numpy as np

BODY_VERTICES = 13380  # of the skin; after them come eyes and the helper surfaces for clothes


@dataclass(frozen=True)
class Surface:
    """Quads of the base mesh: indices of vertices [m, 4] and of points in the UV layout [m, 4]."""

    quads: np.ndarray
    uv_quads: np.ndarray

    def __getitem__(self, chosen: np.ndarray) -> "Surface":
        """The quads where the mask `chosen` [m] is true."""
        return Surface(self.quads[chosen], self.uv_quads[chosen])


@dataclass(frozen=True)
class BodyModel:
    """Body model as stored in the asset."""

    # [n + b, 3] float64, the n vertices and then the b joints of the average adult at rest
    mean: np.ndarray
    # [k, n + b, 3] float64, principal components for coefficients of unit variance
    components: np.ndarray
    bodies: np.ndarray  # [s, k] coefficients of plausible adults
    female: np.ndarray  # [s] bool
    age: np.ndarray  # [s] from 0.67 (young) to 1 (old)
    bone_names: tuple[str, ...]  # b names
    bone_parents: np.ndarray  # [b] int, -1 for the root; parents come before children
    weights: np.ndarray  # [n, b] float64, skinning weights; rows sum to 1
    uv: np.ndarray  # [t, 2] float32, points of the UV layout of the base mesh
    head_uv: np.ndarray  # [4] box of the head in the UV layout: left, bottom, right, top
    head_masks: np.ndarray  # [h, w, 4] uint8 over that box: lips, eyelids, ears, face
    surfaces: dict[str, Surface]  # body, eyes, tights, skirt

    @property
    def vertex_count(self) -> int:
        return len(self.weights)

    def bone(self, name: str) -> int:
        """Index of a bone.

        Args:
            name: one of ``bone_names``.

        Raises:
            ValueError: there is no such bone.
        """
        return self.bone_names.index(name)

    def rest(self, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute a shape at rest, with the lowest point of the skin on y = 0.

        Args:
            coefficients: [k], coefficients of the principal components.

        Returns:
            Vertices [n, 3] and joints [b, 3], metres.
        """
        points = self.mean + np.tensordot(coefficients, self.components, 1)
        points[:, 1] -= points[:BODY_VERTICES, 1].min()
        return points[: self.vertex_count], points[self.vertex_count :]

    def sample_shape(self, rng: np.random.Generator) -> tuple[np.ndarray, bool, float]:
        """Sample an adult by interpolation between two stored ones of the same sex.

        Args:
            rng: samples sex, the two adults and their weights.

        Returns:
            Coefficients [k], true if female, and age from 0.67 (young) to 1 (old).
        """
        female = bool(rng.random() < 0.5)
        pool = np.flatnonzero(self.female == female)
        one, two = rng.choice(pool, 2, replace=False)
        mix = rng.uniform(0.0, 0.35)
        coefficients = (1 - mix) * self.bodies[one] + mix * self.bodies[two]
        return coefficients, female, float((1 - mix) * self.age[one] + mix * self.age[two])


@lru_cache(maxsize=1)
def load_body() -> BodyModel:
    """Read the asset of this package, once per process."""
    with as_file(files("ghgs_people.figures") / "assets" / "body.npz") as path, np.load(path) as data:
        asset = {name: data[name] for name in data.files}
    weights = np.zeros((len(asset["weights"]), len(asset["bone_names"])))
    np.put_along_axis(weights, asset["weight_bones"].astype(np.int64), asset["weights"] / 65535.0, axis=1)
    surfaces = {
        name: Surface(asset[f"{name}_quads"].astype(np.int64), asset[f"{name}_uv_quads"].astype(np.int64))
        for name in ("body", "eyes", "tights", "skirt")
    }
    return BodyModel(
        mean=asset["mean"].astype(np.float64),
        components=asset["components"] * asset["component_scale"].astype(np.float64)[:, None, None],
        bodies=asset["bodies"].astype(np.float64),
        female=asset["female"],
        age=asset["age"],
        bone_names=tuple(str(name) for name in asset["bone_names"]),
        bone_parents=asset["bone_parents"].astype(np.int64),
        weights=weights,
        uv=asset["uv"],
        head_uv=asset["head_uv"],
        head_masks=asset["head_masks"],
        surfaces=surfaces,
    )


def bone_transforms(
    parents: np.ndarray, joints: np.ndarray, rotations: np.ndarray, root: np.ndarray
) -> np.ndarray:
    """Forward kinematics: transforms of the bones from rest to pose.

    Args:
        parents: [b] int, -1 for the root; parents come before children.
        joints: [b, 3] at rest, metres.
        rotations: [b, 3, 3] of each bone in world axes (not relative to its parent).
        root: [3], position of the root joint in the pose, metres.

    Returns:
        [b, 3, 4], rotations and translations in metres.
    """
    posed = np.empty_like(joints)
    for bone, parent in enumerate(parents):
        if parent < 0:
            posed[bone] = root
        else:
            posed[bone] = posed[parent] + rotations[parent] @ (joints[bone] - joints[parent])
    shift = posed - np.einsum("bij,bj->bi", rotations, joints)
    return np.concatenate([rotations, shift[:, :, None]], -1)


def skin(vertices: np.ndarray, weights: np.ndarray, transforms: np.ndarray) -> np.ndarray:
    """Linear blend skinning.

    Args:
        vertices: [n, 3] at rest, metres.
        weights: [n, b] skinning weights, rows sum to 1.
        transforms: [b, 3, 4], transforms of the bones from rest to pose.

    Returns:
        [n, 3] in the pose.
    """
    blended = (weights @ transforms.reshape(len(transforms), 12)).reshape(-1, 3, 4)
    return np.einsum("nij,nj->ni", blended[:, :, :3], vertices) + blended[:, :, 3]
