"""Photographs of textured meshes: image, matte, mask and metric depth from pinhole cameras.

Embree casts ``samples`` x ``samples`` rays on a regular grid through each pixel of the subject's window.

* image: the mean colour of the samples; samples that miss are black, so silhouettes are antialiased and
  premultiplied by their coverage (like an alpha-blended splat on black);
* matte: the share of a pixel's samples that hit the subject;
* mask: true where the matte is at least 0.5;
* depth: z of the hit nearest to the pixel's centre (at the centre itself when ``samples`` is odd), 0 where
  there is none. It is no mean of samples, so that no depth lies between two surfaces."""

import importlib
import platform
from dataclasses import dataclass
from types import ModuleType

import numpy as np
import trimesh

from ghgs_lit.errors import InputError, require
from ghgs_lit.types import Cameras
from ghgs_people.figures.mesh import Person, sample_texture
from ghgs_people.figures.meshing import smooth_normals

# Rays traced at once: they fit the processor's cache, which is three times as fast as a whole photograph.
_CHUNK = 1 << 14


def _embree() -> tuple[ModuleType, ModuleType]:
    """Modules of Embree, which some machines lack. InputError: it is not installed."""
    try:
        return tuple(map(importlib.import_module, ("embreex.rtcore_scene", "embreex.mesh_construction")))
    except ImportError:
        found = f"none ({platform.system()} {platform.machine()} may have no wheel)"
        message = (
            "rendering of meshes: expected the package embreex, or photographs that are rendered elsewhere"
        )
        raise InputError(f"{message}; found {found}") from None


@dataclass(frozen=True)
class Lights:
    """White lights around a person, the same for every camera, so that views agree.

    Shading is Lambertian with soft terminators, ``ambient + sum_l w_l max((n.l + s) / (1 + s), 0)``, and
    multiplies texture values as stored."""

    count: int = 6
    ambient: float = 0.5  # share of ambient light, 0 to 1
    softness: float = 0.3  # s of the formula, 0 (Lambertian) to 1
    exposure: float = 0.6  # approximate mean brightness over all directions of the normal
    elevation: float = 30.0  # largest elevation of a light in degrees
    jitter: float = 0.25  # relative variation of the strengths of the lights, 0 to below 1

    def draw(self, rng: np.random.Generator) -> "LightRig":
        """Draw the lights of one person: evenly spaced in azimuth, with random elevations and strengths.

        Args:
            rng: draws azimuth, elevations and strengths.
        """
        azimuth = 2 * np.pi * (np.arange(self.count) + rng.uniform()) / self.count
        elevation = np.radians(self.elevation) * rng.uniform(-0.3, 1.0, self.count)
        strength = 1 + self.jitter * rng.uniform(-1, 1, self.count)
        directions = np.stack(
            (np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)), -1
        )
        # Mean of max((n.l + s)/(1 + s), 0) over the sphere of normals n is (1 + s) / 4.
        share = (1 - self.ambient) * strength / strength.sum() * 4 / (1 + self.softness)
        arrays = directions.astype(np.float32), (self.exposure * share).astype(np.float32)
        return LightRig(*arrays, self.exposure * self.ambient, self.softness)


@dataclass(frozen=True)
class LightRig:
    """The lights of one person.

    Args:
        directions: [l, 3] unit vectors towards the lights.
        strengths: [l], brightness that each adds to a surface that faces it.
        ambient: brightness without them.
        softness: s of the formula of :class:`Lights`, 0 to 1.
    """

    directions: np.ndarray
    strengths: np.ndarray
    ambient: float
    softness: float

    def shade(self, normals: np.ndarray) -> np.ndarray:
        """Shade surfaces by the formula of :class:`Lights`.

        Args:
            normals: [n, 3] unit vectors.

        Returns:
            Brightness [n], at least 0; texture values are multiplied by it.
        """
        cosine = normals @ self.directions.T
        soft = np.maximum((cosine + self.softness) / (1 + self.softness), 0)
        return self.ambient + soft @ self.strengths


@dataclass(frozen=True)
class RenderedViews:
    """Photographs from n cameras.

    Args:
        images: [n, h, w, 3] float32 in [0, 1], premultiplied by ``alphas``.
        alphas: [n, h, w] float32 in [0, 1].
        depths: [n, h, w] float32, metres, 0 where ``alphas`` are.
    """

    images: np.ndarray
    alphas: np.ndarray
    depths: np.ndarray

    @property
    def masks(self) -> np.ndarray:
        """[n, h, w] bool: at least half of a pixel shows the subject."""
        return self.alphas >= 0.5


class Studio:
    """A person under fixed lights, photographed from any number of cameras.

    Surfaces are double-sided: normals are flipped towards the camera.

    Args:
        person: to photograph, metres.
        lights: around the person; None leaves textures as they are.
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
        self._uv = np.concatenate([part.uv for part in parts]).astype(np.float32)
        self._normals = np.concatenate([smooth_normals(part.vertices, part.faces) for part in parts])
        self._part = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
        self._textures = [part.texture for part in parts]
        corners = self._vertices[self._faces].astype(np.float64)
        self._face_normals = trimesh.unitize(trimesh.triangles.cross(corners)).astype(np.float32)
        scenes, meshes = _embree()
        self._scene = scenes.EmbreeScene(robust=True)
        meshes.TriangleMesh(self._scene, self._vertices, self._faces)

    def shoot(self, cameras: Cameras) -> RenderedViews:
        """Photograph the person.

        Args:
            cameras: n cameras, metres.

        Returns:
            n photographs, black where there is no person.

        Raises:
            InputError: a camera is not finite or has a focal length <= 0.
        """
        intrinsics = cameras.intrinsics.double().numpy()
        extrinsics = cameras.extrinsics.double().numpy()
        size = (len(intrinsics), cameras.height, cameras.width)
        images = np.zeros((*size, 3), np.float32)
        depths = np.zeros(size, np.float32)
        alphas = np.zeros(size, np.float32)
        for n, (matrix, pose) in enumerate(zip(intrinsics, extrinsics, strict=True)):
            is_finite = np.isfinite(matrix).all() and np.isfinite(pose).all()
            expected = "finite values and focal lengths above 0"
            is_right = bool(is_finite and min(matrix[0, 0], matrix[1, 1]) > 0)
            require(is_right, f"camera {n}", expected, matrix.tolist())
            top, bottom, left, right = self._window(matrix, pose, *size[1:])
            step = max(1, _CHUNK // max(1, (right - left) * self.samples**2))
            for row in range(top, bottom, step):
                window = (n, slice(row, min(row + step, bottom)), slice(left, right))
                images[window], alphas[window], depths[window] = self._expose(matrix, pose, *window[1:])
        return RenderedViews(images, alphas, depths)

    def _window(
        self, matrix: np.ndarray, pose: np.ndarray, height: int, width: int
    ) -> tuple[int, int, int, int]:
        """Find the part of an image that all vertices project into.

        Args:
            matrix: intrinsics [3, 3], pixels.
            pose: extrinsics [4, 4], world to camera, metres.
            height: of the image, pixels.
            width: of the image, pixels.

        Returns:
            Top, bottom, left and right in pixels; the whole image where the person is partly behind the
            camera.
        """
        points = self._vertices @ pose[:3, :3].T + pose[:3, 3]
        if points[:, 2].min() <= 1e-3:  # partly behind the camera: the projection has no bounds
            return 0, height, 0, width
        pixels = points @ matrix.T
        low = np.floor((pixels[:, :2] / pixels[:, 2:]).min(0)).astype(int)
        high = np.ceil((pixels[:, :2] / pixels[:, 2:]).max(0)).astype(int)
        left, right = np.clip((low[0], high[0]), 0, width)
        top, bottom = np.clip((low[1], high[1]), 0, height)
        return int(top), int(bottom), int(left), int(right)

    def _expose(
        self, matrix: np.ndarray, pose: np.ndarray, rows: slice, columns: slice
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Photograph a window of an image.

        Args:
            matrix: intrinsics [3, 3], pixels.
            pose: extrinsics [4, 4], world to camera, metres.
            rows: h rows of the image.
            columns: w columns of the image.

        Returns:
            Image [h, w, 3], matte [h, w] and depth [h, w] in metres.
        """
        n = self.samples
        h = rows.stop - rows.start
        w = columns.stop - columns.start
        y = (rows.start + (np.arange(h * n) + 0.5) / n - matrix[1, 2]) / matrix[1, 1]
        u = columns.start + (np.arange(w * n) + 0.5) / n - matrix[0, 2]
        x = (u - matrix[0, 1] * y[:, None]) / matrix[0, 0]
        rays = np.stack((x, np.broadcast_to(y[:, None], x.shape), np.ones_like(x)), -1)
        # [h, n, w, n] -> one row of n * n samples per pixel. Rays have z = 1, so distances are depths.
        rays = rays.reshape(h, n, w, n, 3).transpose(0, 2, 1, 3, 4).reshape(-1, 3)
        directions = (rays @ pose[:3, :3]).astype(np.float32)
        origin = (-pose[:3, :3].T @ pose[:3, 3]).astype(np.float32)

        hits = self._scene.run(np.tile(origin, (len(directions), 1)), directions, output=True)
        hit = hits["primID"] >= 0
        u = hits["u"]
        v = hits["v"]
        depth = np.where(hit, hits["tfar"], 0)
        weights = np.stack((1 - u - v, u, v), -1)
        colors = np.zeros((len(rays), 3), np.float32)
        colors[hit] = self._shade(directions[hit], hits["primID"][hit], weights[hit])

        hit = hit.reshape(h, w, n * n)
        depth = depth.reshape(h, w, n * n)
        offset = np.abs(np.arange(n) - (n - 1) / 2)
        order = np.argsort(offset[:, None] ** 2 + offset**2, axis=None, kind="stable")
        nearest = order[hit[..., order].argmax(-1)]
        alpha = hit.mean(-1, dtype=np.float32)
        center = np.take_along_axis(depth, nearest[..., None], -1)[..., 0]
        image = colors.reshape(h, w, n * n, 3).mean(2)
        return np.clip(image, 0, 1), alpha, np.where(alpha > 0, center, 0)

    def _shade(self, directions: np.ndarray, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Colour what rays hit.

        Args:
            directions: [n, 3] of the rays.
            face: [n] index of the face that each hits.
            weights: [n, 3] barycentric coordinates of the hit.

        Returns:
            [n, 3] in [0, 1] where textures alone are shown; light may exceed 1.
        """
        colors = np.empty((len(face), 3), np.float32)
        part = self._part[face]
        for k in np.unique(part):
            index = np.flatnonzero(part == k)
            uv = np.einsum("nk,nkc->nc", weights[index], self._uv[self._faces[face[index]]])
            colors[index] = sample_texture(self._textures[k], uv)
        if self.lights is None:
            return colors
        flat = self._face_normals[face]
        smooth = trimesh.unitize(np.einsum("nk,nkc->nc", weights, self._normals[self._faces[face]]))
        cancelled = np.square(smooth).sum(-1, keepdims=True) < 0.5
        normals = np.where(cancelled, flat, smooth)
        # The flat normal decides, so that all smooth normals of a face flip together.
        behind = np.einsum("nc,nc->n", flat, directions) > 0
        normals = np.where(behind[:, None], -normals, normals)
        return colors * self.lights.shade(normals)[:, None]
