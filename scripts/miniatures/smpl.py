"""A stand-in for the licensed SMPL model, made from the built-in body, and SMPL parameters of people.

It has SMPL's arrays, shapes and 24 joints, so that ``smplx`` can pose it, but none of its data: shape
blend shapes are the first ten components of the built-in body, pose blend shapes are zero.
"""

import pickle
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from ghgs_people.figures.body import BODY_VERTICES, BodyModel, load_body
from ghgs_people.figures.generate import pose_figure
from ghgs_people.figures.mesh import Person

VERTICES, SHAPES = 6890, 10
# The joints of SMPL in order: the built-in bone that starts there, and the index of the parent joint.
JOINTS = (
    ("root", -1), ("upperleg01.L", 0), ("upperleg01.R", 0), ("spine05", 0), ("lowerleg01.L", 1),
    ("lowerleg01.R", 2), ("spine03", 3), ("foot.L", 4), ("foot.R", 5), ("spine01", 6), ("toe2-1.L", 7),
    ("toe2-1.R", 8), ("neck01", 9), ("clavicle.L", 9), ("clavicle.R", 9), ("head", 12), ("upperarm01.L", 13),
    ("upperarm01.R", 14), ("lowerarm01.L", 16), ("lowerarm01.R", 17), ("wrist.L", 18), ("wrist.R", 19),
    ("finger3-1.L", 20), ("finger3-1.R", 21),
)  # fmt: skip
PARENTS = np.array([parent for _, parent in JOINTS])
# Number of nearest vertices that a joint is regressed from.
_NEAR = 150


def chosen_vertices() -> np.ndarray:
    """Indices [6890] of the stand-in's vertices in the built-in body."""
    return np.linspace(0, BODY_VERTICES - 1, VERTICES).astype(int)


@lru_cache(maxsize=1)
def stand_in() -> dict[str, np.ndarray]:
    """The arrays of an SMPL model file."""
    body, chosen = load_body(), chosen_vertices()
    joints = [body.vertex_count + body.bone(name) for name, _ in JOINTS]
    return {
        "v_template": body.mean[chosen],
        "shapedirs": np.moveaxis(body.components[:SHAPES, chosen], 0, -1),
        "posedirs": np.zeros((VERTICES, 3, 9 * (len(JOINTS) - 1))),
        "J_regressor": np.stack([_regressor(body, chosen, joint) for joint in joints]),
        "kintree_table": np.stack((PARENTS, np.arange(len(JOINTS)))),
        "weights": _weights(body)[chosen],
        "f": np.zeros((13776, 3), np.uint32),
    }


def write_stand_in(folder: Path) -> Path:
    """Write ``<folder>/smpl/SMPL_NEUTRAL.pkl``, the path that ``smplx`` expects; return ``folder``."""
    path = folder / "smpl" / "SMPL_NEUTRAL.pkl"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as stream:
        pickle.dump(stand_in(), stream, protocol=2)
    return folder


def parameters(seed: int, index: int, person: Person, pose: np.ndarray) -> dict[str, np.ndarray]:
    """SMPL parameters of ``figures.generate(seed, index)`` moved by ``pose`` [4, 4], as in HuMMan."""
    body = load_body()
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence([seed, index]).spawn(4)]
    coefficients, _, _ = body.sample_shape(streams[0])
    figure = pose_figure(body, coefficients, streams[1])
    to_person, _, _ = trimesh.registration.procrustes(
        figure.posed, person.body_vertices, reflection=False, scale=False
    )
    place = pose @ to_person
    bones = [body.bone(name) for name, _ in JOINTS]
    turns = place[:3, :3] @ figure.transforms[bones, :, :3]
    local = [turns[0], *(turns[p].T @ turn for p, turn in zip(PARENTS[1:], turns[1:], strict=True))]
    vectors = Rotation.from_matrix(np.stack(local)).as_rotvec()
    model = stand_in()
    betas = coefficients[:SHAPES]
    pelvis = model["J_regressor"][0] @ (model["v_template"] + model["shapedirs"] @ betas)
    root = figure.transforms[bones[0]]
    there = place[:3, :3] @ (root[:, :3] @ figure.joints[bones[0]] + root[:, 3]) + place[:3, 3]
    return {
        "betas": betas.astype(np.float32),
        "body_pose": vectors[1:].reshape(-1).astype(np.float32),
        "global_orient": vectors[0].astype(np.float32),
        "transl": (there - pelvis).astype(np.float32),
    }


def _regressor(body: BodyModel, chosen: np.ndarray, joint: int) -> np.ndarray:
    """Weights [6890] of vertices near a joint, summing to 1, whose mean is the joint for every shape."""
    distance = np.linalg.norm(body.mean[chosen] - body.mean[joint], axis=-1)
    near = np.argsort(distance)[:_NEAR]
    shapes = np.concatenate((body.mean[None], body.components[:SHAPES]))
    rows = np.moveaxis(shapes[:, chosen[near]], 1, -1).reshape(-1, _NEAR)
    rows = np.concatenate((rows, np.ones((1, _NEAR))))
    weights = np.zeros(len(chosen))
    weights[near] = np.linalg.lstsq(rows, np.append(shapes[:, joint].reshape(-1), 1), rcond=1e-6)[0]
    return weights


def _weights(body: BodyModel) -> np.ndarray:
    """Skinning weights [n, 24]: each bone belongs to its nearest ancestor that is a joint of SMPL."""
    joint_of = {body.bone(name): j for j, (name, _) in enumerate(JOINTS)}
    weights = np.zeros((body.vertex_count, len(JOINTS)))
    for bone in range(len(body.bone_names)):
        above = bone
        while above not in joint_of:
            above = int(body.bone_parents[above])
        weights[:, joint_of[above]] += body.weights[:, bone]
    return weights
