"""Render image, matte, mask and metric depth of textured meshes from pinhole cameras.

Embree casts ``samples`` x ``samples`` rays on a regular grid through each pixel that can show the subject.

* image: mean colour of the samples; samples that miss are black, so silhouettes are antialiased and
  premultiplied by their coverage (like an alpha-blended splat on black);
* matte: fraction of a pixel's samples that hit the subject;
* mask: true where the matte is at least 0.5;
* depth: z of the hit nearest to the pixel's centre (at the centre itself if ``samples`` is odd), 0 without
  a hit. It is not a mean of samples, so that no depth lies between two surfaces."""

import importlib
import platform
from dataclasses import dataclass
from types import ModuleType

import numpy as np
import trimesh

from ghgs_lit.errors import InputError
from ghgs_lit.types import Cameras
from ghgs_people.cpu import kernel
from ghgs_people.figures.mesh import Person
from ghgs_people.figures.meshing import smooth_normals
from ghgs_people.lights import LightRig
from ghgs_people.rig import Rig

# Rays traced at once; they fit into the processor's cache, three times as fast as a whole photograph
_CHUNK = 1 << 14
# Side in pixels of the renderings that the exposure is measured from, and factor on their light
_TRIAL = 64
_DIM = 0.25
# Brightness above which highlights are compressed to below 1, as in cameras
_KNEE = 0.8


def _embree() -> tuple[ModuleType, ModuleType]:
    """Import the modules of Embree, which has no wheel for some machines; raises InputError without it."""
    try:
        return tuple(map(importlib.import_module, ("embreex.rtcore_scene", "embreex.mesh_construction")))
    except ImportError:
        found = f"none ({platform.system()} {platform.machine()} may have no wheel)"
        message = (
            "rendering of meshes: expected the package embreex, or photographs that are rendered elsewhere"
        )
        raise InputError(f"{message}; found {found}") from None


@dataclass(frozen=True)
class RenderedViews:
    """Renderings from n cameras.

    Args:
        images: [n, h, w, 3] float32 in [0, 1], premultiplied by ``alphas``.
        alphas: [n, h, w] float32 in [0, 1].
        depths: [n, h, w] float32, metres, 0 where ``alphas`` are 0.
    """

    images: np.ndarray
    alphas: np.ndarray
    depths: np.ndarray

    @property
    def masks(self) -> np.ndarray:
        """[n, h, w] bool, true where the subject covers at least half of the pixel."""
        return self.alphas >= 0.5


class Studio:
    """Renderer of a person under fixed lights.

    Surfaces are double-sided: normals are flipped towards the camera.

    Args:
        person: the person, metres.
        lights: lights around the person; None: textures are rendered unlit.
        samples: each pixel is the mean of samples x samples rays; 1 to 16.

    Raises:
        InputError: the person has no faces, or Embree is not installed.
    """

    def __init__(self, person: Person, lights: LightRig | None, samples: int = 3) -> None:
        parts = [part for part in person.parts if len(part.faces)]
        if not parts:
            raise InputError(f"{person.name}: expected a mesh with faces; found none")
        self.lights = lights
        self.samples = samples
        counts = np.cumsum([0] + [len(part.vertices) for part in parts])
        self._vertices = np.concatenate([part.vertices for part in parts]).astype(np.float32)
        self._faces = np.concatenate([p.faces + n for p, n in zip(parts, counts, strict=False)]).astype(
            np.int32
        )
        corners = self._vertices[self._faces].astype(np.float64)
        flat = trimesh.unitize(trimesh.triangles.cross(corners)).astype(np.float32)
        numbers = np.repeat(np.arange(len(parts), dtype=np.int32), [len(part.faces) for part in parts])
        shapes = np.array([part.texture.shape[:2] for part in parts])
        first = np.cumsum([0, *shapes.prod(1)])[:-1, None]
        texels = np.concatenate([part.texture.reshape(-1, 3) for part in parts])
        self._textures = (texels, np.concatenate((first, shapes), 1))
        scenes, meshes = _embree()
        self._scene = scenes.EmbreeScene(robust=True)
        meshes.TriangleMesh(self._scene, self._vertices, self._faces)
        uv = np.concatenate([part.uv for part in parts]).astype(np.float32)
        gains = np.zeros((len(uv), 2), np.float32)
        self._surface = (np.concatenate((uv, gains), 1)[self._faces], flat, numbers)
        if lights is not None:
            normals = np.concatenate([smooth_normals(part.vertices, part.faces) for part in parts])
            self._light(normals)

    def _light(self, normals: np.ndarray) -> None:
        """Compute the light at all corners and the exposure; ``normals`` [n, 3] of vertices may be 0."""
        corners, flat, _ = self._surface
        lost = ~normals.any(1)
        for corner in range(3):
            at = self._faces[:, corner]
            normals[at[lost[at]]] = flat[lost[at]]
        light = self.lights.shade(self._vertices, normals, self._is_blocked)
        tall = np.ptp(self._vertices, axis=0).max()
        middle = (self._vertices.min(0) + self._vertices.max(0)) / 2
        around = Rig(radius=4 * tall, look_at=tuple(middle), pitch=0, focal=3, shift_y=0)
        cameras = around.cameras(np.arange(8) * 45.0, _TRIAL, _TRIAL)
        corners[..., 2:] = (_DIM * light - 1)[self._faces]  # dimmed so that no highlight is compressed
        trial = self.shoot(cameras)
        self.lights = self.lights.expose(float(trial.images.mean() / trial.alphas.mean()) / _DIM)
        corners[..., 2:] = (self.lights.exposure * light - 1)[self._faces]

    def _is_blocked(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Whether rays [n, 3], float32, hit the person."""
        return self._scene.run(origins, directions, query="OCCLUDED") >= 0

    def shoot(self, cameras: Cameras) -> RenderedViews:
        """Render the person.

        Args:
            cameras: n cameras, metres.

        Returns:
            n renderings on black.
        """
        intrinsics = cameras.intrinsics.double().numpy()
        extrinsics = cameras.extrinsics.double().numpy()
        size = (len(intrinsics), cameras.height, cameras.width)
        images = np.zeros((*size, 3), np.float32)
        depths = np.zeros(size, np.float32)
        alphas = np.zeros(size, np.float32)
        for n, (matrix, pose) in enumerate(zip(intrinsics, extrinsics, strict=True)):
            self._expose(matrix, pose, images[n], alphas[n], depths[n])
        return RenderedViews(images, alphas, depths)

    def _expose(
        self, matrix: np.ndarray, pose: np.ndarray, image: np.ndarray, alpha: np.ndarray, depth: np.ndarray
    ) -> None:
        """Render the person from one camera into ``image``, ``alpha`` and ``depth`` (metres)."""
        n = self.samples
        knee = 1.0 if self.lights is None else _KNEE
        covered = np.zeros(alpha.shape, bool)
        kernel.cover()(self._vertices, self._faces, matrix, pose, covered)
        pixels = np.flatnonzero(covered)
        offset = np.abs(np.arange(n) - (n - 1) / 2)
        order = np.argsort(offset[:, None] ** 2 + offset**2, axis=None, kind="stable")
        maps = (image.reshape(-1, 3), alpha.reshape(-1), depth.reshape(-1))
        step = max(1, _CHUNK // n**2)
        origins = np.tile((-pose[:3, :3].T @ pose[:3, 3]).astype(np.float32), (step * n**2, 1))
        for first in range(0, len(pixels), step):
            some = pixels[first : first + step]
            rays = np.empty((len(some) * n**2, 3), np.float32)
            kernel.aim()(some, alpha.shape[1], n, matrix, pose, rays)
            hits = self._scene.run(origins[: len(rays)], rays, output=True)
            hits = tuple(hits[name] for name in ("primID", "u", "v", "tfar"))
            kernel.expose()(some, order, rays, hits, self._surface, self._textures, knee, *maps)
