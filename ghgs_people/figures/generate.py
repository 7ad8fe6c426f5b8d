"""Generate a person (shape, pose, clothes, colours) from a seed and an index."""

from copy import deepcopy
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ghgs_lit.errors import require
from ghgs_people.figures import garments
from ghgs_people.figures.ambient_occlusion import Spheres, ambient_occlusion, occluding_spheres
from ghgs_people.figures.body import BODY_VERTICES, BodyModel, load_body, skin
from ghgs_people.figures.charts import Chart, chart
from ghgs_people.figures.complexion import (
    Complexion,
    eye_texture,
    head_texture,
    sample_complexion,
    skin_texture,
)
from ghgs_people.figures.garment_textures import bottom_texture, shoe_texture, top_texture
from ghgs_people.figures.garments import Figure
from ghgs_people.figures.hair import make_beanie, make_hair, sample_haircut, under_hat
from ghgs_people.figures.mesh import Person, TexturedMesh
from ghgs_people.figures.meshing import triangles, vertex_normals
from ghgs_people.figures.noise import Noise
from ghgs_people.figures.outfit import Outfit, sample_outfit
from ghgs_people.figures.place import Place
from ghgs_people.figures.pose import sample_pose

OVERLAP = 0.03  # how far skin and inner layers go on below an outer garment, metres
MAX_YAW = 30.0  # degrees to either side
MAX_POSES = 6  # attempts until the arms are clear of the trunk, each with the arms further apart


class Character:
    """A person independent of the pose: shape, clothes, colours and hair.

    ``first`` is the initial pose; ``motion_rng`` samples others.

    Args:
        seed: seed of a population, at least 0.
        index: number of the person in its population, at least 0.
        active: whether ``first`` is a pose of sport or dance.

    Raises:
        InputError: a number is negative.
    """

    def __init__(self, seed: int, index: int, active: bool = False) -> None:
        require(seed >= 0, "seed", "a number of at least 0", seed)
        require(index >= 0, "index", "a number of at least 0", index)
        streams = [np.random.default_rng(s) for s in np.random.SeedSequence([seed, index]).spawn(5)]
        shape_rng, self.pose_rng, self.cloth_rng, self.look_rng, self.motion_rng = streams
        self.name = f"{'active' if active else 'person'}_{seed}_{index:04d}"
        self.body = load_body()
        self.coefficients, female, age = self.body.sample_shape(shape_rng)
        self.first = pose_figure(self.body, self.coefficients, self.pose_rng, active)
        self.outfit = sample_outfit(self.cloth_rng, female)
        self.look = sample_complexion(self.look_rng, female, age)
        cut = sample_haircut(self.look_rng, female)
        self.cut = under_hat(cut) if self.outfit.beanie else cut

    def dress(self, figure: Figure, spheres: Spheres) -> list[TexturedMesh]:
        """Create skin, clothes, hair and cap over a figure of this shape, the same in each call.

        Args:
            figure: this person in any pose.
            spheres: spheres of its body in that pose, which cast shadows.
        """
        scalp = 0.25 if self.cut.style == "bald" else 1.0
        parts = [skin_part(figure, self.outfit, self.look, spheres, scalp)]
        parts += dress(figure, self.outfit, spheres, deepcopy(self.cloth_rng))
        parts += make_hair(figure, self.cut, self.look, deepcopy(self.look_rng))
        parts += [make_beanie(figure, self.outfit.beanie)] if self.outfit.beanie else []
        return [part for part in parts if len(part.faces)]  # a jacket may hide all of a collar

    def placed(self, parts: list[TexturedMesh], bodies: np.ndarray, first: int) -> Person:
        """Place meshes in front of the cameras, aligned by the first pose.

        Args:
            parts: meshes in one frame; the ``first`` ones are in the first pose and stand on y = 0.
            bodies: vertices [k, 3] of the body under them, of all poses one after the other,
                metres.
            first: number of parts of the first pose.

        Returns:
            The person, turned by a random angle about y.
        """
        turn = Rotation.from_euler("y", self.pose_rng.uniform(-MAX_YAW, MAX_YAW), degrees=True).as_matrix()
        origin = 0.5 * (self.first.posed.min(0) + self.first.posed.max(0))
        origin[1] = min(float(part.vertices[:, 1].min()) for part in parts[:first])
        person = Person(self.name, tuple(parts), bodies)
        return person.mapped(lambda vertices: (vertices - origin) @ turn.T)


def generate(seed: int, index: int, active: bool = False) -> Person:
    """Generate a person, reproducible on every machine up to rounding.

    An adult of 1.52 to 1.87 m (barefoot and upright), in metres, with feet on y = 0, the bounding
    box of the body centred over the origin, facing +z up to 30 degrees of yaw. Part 0 is the skin;
    clothes, hair and a cap follow.

    Args:
        seed: seed of a population, at least 0.
        index: number of the person in its population, at least 0.
        active: whether the pose is one of sport or dance.

    Raises:
        InputError: a number is negative.
    """
    person = Character(seed, index, active)
    parts = person.dress(person.first, occluding_spheres(person.first))
    return person.placed(parts, person.first.posed, len(parts))


def pose_figure(
    body: BodyModel, coefficients: np.ndarray, rng: np.random.Generator, active: bool = False
) -> Figure:
    """Sample a pose in which the arms do not intersect the trunk.

    Args:
        body: the base mesh.
        coefficients: [k] of the person's shape.
        rng: samples the pose.
        active: sample poses of sport or dance.

    Returns:
        The naked person; after `MAX_POSES` attempts the last one.
    """
    rest, joints = body.rest(coefficients)
    faces = triangles(body.surfaces["body"].quads)
    for attempt in range(MAX_POSES):
        transforms = sample_pose(body, joints, rng, widen=attempt / (MAX_POSES - 1), active=active)
        posed = skin(rest[:BODY_VERTICES], body.weights[:BODY_VERTICES], transforms)
        if arm_depth(posed, faces) < 0.012:
            break
    return Figure(rest, joints, faces, transforms, posed)


def arm_depth(posed: np.ndarray, faces: np.ndarray) -> float:
    """Penetration depth of forearms and hands into trunk and thighs.

    Args:
        posed: vertices [BODY_VERTICES, 3] of the skin in the pose, metres.
        faces: [m, 3] of the skin.

    Returns:
        Metres, 0 without penetration.
    """
    limb, solid = _limbs_and_trunk()
    normals = vertex_normals(posed, faces)
    distance, nearest = cKDTree(posed[solid]).query(posed[limb], distance_upper_bound=0.08)
    near = np.isfinite(distance)
    nearest = solid[nearest[near]]
    limb = limb[near]
    height = np.einsum("ki,ki->k", posed[limb] - posed[nearest], normals[nearest])
    return float(np.clip(-height, 0, None).max(initial=0.0))


@lru_cache(maxsize=1)
def _limbs_and_trunk() -> tuple[np.ndarray, np.ndarray]:
    """Indices of some vertices of forearms and hands, and of parts that they must not intersect."""
    body = load_body()
    bones = body.weights[:BODY_VERTICES].argmax(1)
    limbs = [name.startswith(("lowerarm", "wrist", "finger")) for name in body.bone_names]
    trunk = [name.startswith(("spine", "root", "upperleg", "clavicle", "head")) for name in body.bone_names]
    return np.flatnonzero(np.array(limbs)[bones])[::4], np.flatnonzero(np.array(trunk)[bones])[::3]


def dress(figure: Figure, outfit: Outfit, spheres: Spheres, rng: np.random.Generator) -> list[TexturedMesh]:
    """Create top and jacket, trousers or skirt, and shoes, each without parts hidden by the next one.

    Args:
        figure: the wearer.
        outfit: what is worn.
        spheres: spheres of the body in the pose, which cast shadows.
        rng: samples folds, emblems and trims.
    """
    noise = Noise(rng, 2.3, 3.0, 128)
    top = outfit.top
    jacket = outfit.jacket
    bottom = outfit.bottom
    shoes = outfit.shoes
    upper = chart("upper")
    lower = chart("skirt" if bottom.kind == "skirt" else "lower")
    feet = chart("shoes")

    def sew(piece: Chart, points: np.ndarray, field: np.ndarray, texture: np.ndarray) -> TexturedMesh:
        """Make the mesh of a garment.

        Args:
            piece: its chart.
            points: [g, 3] in the pose, metres.
            field: [g], positive where the garment is.
            texture: [h, w, 3] uint8, without shadows.
        """
        return piece.mesh(points, field, piece.shade(texture, ambient_occlusion(piece, points, spheres)))

    field = garments.top_field(upper.place, top)
    if top.tucked:
        field = np.minimum(field, OVERLAP - garments.bottom_field(upper.place, bottom))
    if jacket:
        field = np.minimum(field, OVERLAP - garments.top_field(upper.place, jacket))
    points = garments.drape_top(figure, top, noise)
    texture = top_texture(top, noise, rng)
    parts = [sew(upper, points, field, texture)]
    if top.neck == "collar":
        points, collar = garments.fold_collar(points, top)
        parts.append(sew(upper, points, np.minimum(collar, field), texture))
    if jacket:
        points = garments.drape_top(figure, jacket, noise)
        texture = top_texture(jacket, noise, rng)
        parts.append(sew(upper, points, garments.top_field(upper.place, jacket), texture))
    field = garments.bottom_field(lower.place, bottom)
    for outer in (jacket, None if top.tucked else top):
        if outer:
            field = np.minimum(field, OVERLAP - garments.top_field(lower.place, outer))
    if bottom.kind == "skirt":
        points = garments.drape_skirt(figure, bottom, noise, rng)
    else:
        points = garments.drape_trousers(figure, bottom, noise)
    parts.append(sew(lower, points, field, bottom_texture(bottom, noise)))
    field = garments.shoe_field(feet.place, shoes)
    if bottom.hem < 0.2:  # what trousers cover
        field = np.minimum(field, bottom.hem + OVERLAP - feet.place.y)
    parts.append(sew(feet, garments.shape_shoes(figure, shoes), field, shoe_texture(shoes)))
    return parts


def skin_part(
    figure: Figure, outfit: Outfit, look: Complexion, spheres: Spheres, scalp: float
) -> TexturedMesh:
    """Create head, eyes and the skin that is not covered by clothes.

    They form one mesh, so that normals are continuous at the neck.

    Args:
        figure: the person.
        outfit: what covers the skin.
        look: colours of the person.
        spheres: spheres of the body in the pose, which cast shadows.
        scalp: how strongly hair covers the scalp, 0 to 1.
    """
    textures = {
        "head": head_texture(look, scalp),
        "skin": skin_texture(look, outfit.shoes),
        "eyes": eye_texture(look),
    }
    parts = []
    for name, texture in textures.items():
        piece = chart(name)
        points = skin(piece.interpolation @ figure.rest, piece.weights, figure.transforms)
        field = np.ones(len(points))
        if name != "eyes":
            texture = piece.shade(texture, ambient_occlusion(piece, points, spheres))
        if name == "skin":
            field = bare_field(piece.place, outfit)
            # skin below clothes must not pierce them
            under = np.clip(OVERLAP - field, 0.0, OVERLAP)
            points = points - 0.12 * under[:, None] * vertex_normals(points, piece.point_faces)
        parts.append(piece.mesh(points, field, texture))
    return join(parts)


def join(parts: list[TexturedMesh]) -> TexturedMesh:
    """Merge at least one opaque mesh into one, with the textures side by side."""
    height = max(part.texture.shape[0] for part in parts)
    width = sum(part.texture.shape[1] for part in parts)
    textures = []
    uv = []
    faces = []
    left = 0
    count = 0
    for part in parts:
        h, w, _ = part.texture.shape
        textures.append(np.pad(part.texture, ((height - h, 0), (0, 0), (0, 0)), mode="edge"))
        uv.append((part.uv * [w, h] + [left, 0]) / [width, height])
        faces.append(part.faces + count)
        left = left + w
        count = count + len(part.vertices)
    vertices = np.concatenate([part.vertices for part in parts])
    uv = np.concatenate(uv).astype(np.float32)
    return TexturedMesh(vertices, np.concatenate(faces), uv, np.concatenate(textures, 1))


def bare_field(place: Place, outfit: Outfit) -> np.ndarray:
    """Field of bare skin.

    Args:
        place: places of n points.
        outfit: what covers the skin.

    Returns:
        [n] metres, positive on visible skin, and `OVERLAP` further below the clothes.
    """
    covered = np.maximum(garments.top_field(place, outfit.top), garments.shoe_field(place, outfit.shoes))
    bottom = garments.bottom_field(place, outfit.bottom)
    if outfit.bottom.kind == "skirt":  # below it legs are visible
        bottom = np.minimum(bottom, place.y - outfit.bottom.hem - 0.12)
    covered = np.maximum(covered, bottom)
    return OVERLAP - covered
