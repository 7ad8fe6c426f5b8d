"""CPU kernels of the renderer: pixels that can show the subject, rays through them, colours of hits.

Sums have the order and precision of the formulas in NumPy, so that results are bit-equal to them."""

import math

import numpy as np
from numba.core import types

from ghgs_lit.ops.compile import FLOATS, NUMBER, helper, kernel_for

ZERO, HALF, ONE = (np.float32(x) for x in (0, 0.5, 1))
LEVELS = np.arange(256, dtype=np.float32) / np.float32(255)
# Margin in pixels around the box of a projected triangle, larger than rounding errors
MARGIN = 0.0625
# Depth in metres below which projections are unbounded
NEAR = 1e-3


def _array(kind, dimensions):
    return types.Array(kind, dimensions, "C")


_DOUBLES = [_array(types.float64, dimensions) for dimensions in range(4)]
_INDICES = [_array(types.int32, dimensions) for dimensions in range(3)]
_PLACES = _array(types.int64, 1)
_SURFACE = types.Tuple((_array(types.float32, 3), FLOATS[2], _INDICES[1]))
_TEXTURES = types.Tuple((_array(types.uint8, 2), _array(types.int64, 2)))
_HITS = types.Tuple((_INDICES[1], FLOATS[1], FLOATS[1], FLOATS[1]))


@kernel_for(FLOATS[2], _INDICES[2], _DOUBLES[2], _DOUBLES[2], _array(types.boolean, 2))
def cover(vertices, faces, matrix, pose, covered):
    """Find the pixels that can show a triangle: those in the box of its projection.

    Args:
        vertices: [n, 3], metres.
        faces: [m, 3].
        matrix: intrinsics [3, 3], pixels.
        pose: extrinsics [4, 4], world to camera, metres.
        covered: [h, w], initially false; all pixels become true if a vertex is not in front of the camera.
    """
    height, width = covered.shape
    columns = np.empty(len(vertices))
    rows = np.empty(len(vertices))
    for i in range(len(vertices)):
        x, y, z = (np.float64(vertices[i, 0]), np.float64(vertices[i, 1]), np.float64(vertices[i, 2]))
        a = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]
        b = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]
        c = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        if c <= NEAR:
            covered[:] = True
            return
        # Clamped so that integers stay small.
        columns[i] = min(max((matrix[0, 0] * a + matrix[0, 1] * b) / c + matrix[0, 2], -9.0), width + 9.0)
        rows[i] = min(max(matrix[1, 1] * b / c + matrix[1, 2], -9.0), height + 9.0)
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        left = math.floor(min(columns[i], columns[j], columns[k]) - MARGIN)
        right = math.floor(max(columns[i], columns[j], columns[k]) + MARGIN)
        top = math.floor(min(rows[i], rows[j], rows[k]) - MARGIN)
        bottom = math.floor(max(rows[i], rows[j], rows[k]) + MARGIN)
        for row in range(max(top, 0), min(bottom, height - 1) + 1):
            for column in range(max(left, 0), min(right, width - 1) + 1):
                covered[row, column] = True


@kernel_for(_PLACES, NUMBER, NUMBER, _DOUBLES[2], _DOUBLES[2], FLOATS[2])
def aim(pixels, width, samples, matrix, pose, rays):
    """Compute rays through pixels, with z = 1 in the camera's frame, so that distances are depths.

    Args:
        pixels: [p], row * width + column.
        width: width of the image, pixels.
        samples: s; each pixel has s x s rays on a regular grid.
        matrix: intrinsics [3, 3], pixels.
        pose: extrinsics [4, 4], world to camera.
        rays: output [p * s * s, 3], directions in the world, those of a pixel by rows.
    """
    n = 0
    for p in range(len(pixels)):
        row = pixels[p] // width
        column = pixels[p] % width
        for i in range(samples):
            y = (row + (i + 0.5) / samples - matrix[1, 2]) / matrix[1, 1]
            for j in range(samples):
                u = column + (j + 0.5) / samples - matrix[0, 2]
                x = (u - matrix[0, 1] * y) / matrix[0, 0]
                for c in range(3):
                    rays[n, c] = x * pose[0, c] + y * pose[1, c] + pose[2, c]
                n += 1


@helper
def _blend(a, b, c, d, shares):
    """Mean of four texels, 0 to 255, weighted by ``shares``."""
    return shares[0] * LEVELS[a] + shares[1] * LEVELS[b] + shares[2] * LEVELS[c] + shares[3] * LEVELS[d]


@helper
def _interpolate(corners, face, weights, k):
    """Interpolate attribute ``k`` (0 to 3) at a hit with barycentric ``weights``.

    ``corners`` [m, 3, 4] has u and v of the texture, and light minus 1 in front and behind each corner."""
    first, second, third = weights
    return first * corners[face, 0, k] + second * corners[face, 1, k] + third * corners[face, 2, k]


@helper
def _light(surface, face, weights, rays, n):
    """Factor on the texture at a hit, on the side that ray ``n`` comes from; ``surface`` has corners as in
    :func:`_interpolate` and unit normals [m, 3] of the faces."""
    corners, flat, _ = surface
    along = flat[face, 0] * rays[n, 0] + flat[face, 1] * rays[n, 1] + flat[face, 2] * rays[n, 2]
    return ONE + _interpolate(corners, face, weights, 3 if along > ZERO else 2)


@helper
def _compress(value, knee):
    """Compress a brightness to below 1, with a decreasing slope above the knee."""
    return value if value <= knee else ONE - (ONE - knee) * (ONE - knee) / (value - (knee + knee - ONE))


@helper
def _color(surface, textures, face, weights):
    """Bilinear sample of a repeating texture at a hit, 0 to 1.

    Args:
        surface: corners as in :func:`_interpolate`, normals, and the part [m] of each face.
        textures: texels [t, 3] of all parts; first texel, height and width [k, 3] of each part.
        face: index of the face.
        weights: barycentric coordinates of the hit.
    """
    corners, _, parts = surface
    texels, shapes = textures
    first, height, width = shapes[parts[face], 0], shapes[parts[face], 1], shapes[parts[face], 2]
    x = _interpolate(corners, face, weights, 0) * np.float32(width) - HALF
    y = (ONE - _interpolate(corners, face, weights, 1)) * np.float32(height) - HALF
    left = math.floor(x)
    top = math.floor(y)
    fx = x - np.float32(left)
    fy = y - np.float32(top)
    left %= width
    top %= height
    right = left + 1 if left + 1 < width else 0
    bottom = top + 1 if top + 1 < height else 0
    a = texels[first + top * width + left]
    b = texels[first + top * width + right]
    c = texels[first + bottom * width + left]
    d = texels[first + bottom * width + right]
    shares = ((ONE - fx) * (ONE - fy), fx * (ONE - fy), (ONE - fx) * fy, fx * fy)
    return (
        _blend(a[0], b[0], c[0], d[0], shares),
        _blend(a[1], b[1], c[1], d[1], shares),
        _blend(a[2], b[2], c[2], d[2], shares),
    )


@kernel_for(
    _PLACES, _PLACES, FLOATS[2], _HITS, _SURFACE, _TEXTURES, types.float32, FLOATS[2], FLOATS[1], FLOATS[1]
)
def expose(pixels, order, rays, hits, surface, textures, knee, image, matte, depth):
    """Compute pixels from the hits of their rays.

    Args:
        pixels: [p], indices of pixels.
        order: [s], samples of a pixel from its centre outwards.
        rays: [p * s, 3], directions.
        hits: face [p * s] (-1: none), second and third barycentric coordinate, distance.
        surface: corners, normals and parts of the faces, as in :func:`_light` and :func:`_color`.
        textures: as in :func:`_color`.
        knee: brightness above which highlights are compressed; 1: they are clipped.
        image: output [h * w, 3], mean colour of the samples, with black for those that miss.
        matte: output [h * w], fraction of samples that hit.
        depth: output [h * w], distance of the hit nearest to the pixel's centre.
    """
    faces, us, vs, distances = hits
    samples = len(order)
    count = np.float32(samples)
    for p in range(len(pixels)):
        red, green, blue, hit = ZERO, ZERO, ZERO, ZERO
        for n in range(p * samples, (p + 1) * samples):
            face = faces[n]
            if face < 0:
                continue
            hit += ONE
            weights = (ONE - us[n] - vs[n], us[n], vs[n])
            light = _light(surface, face, weights, rays, n)
            color = _color(surface, textures, face, weights)
            red += _compress(color[0] * light, knee)
            green += _compress(color[1] * light, knee)
            blue += _compress(color[2] * light, knee)
        if hit == ZERO:
            continue
        place = pixels[p]
        image[place, 0] = red / count
        image[place, 1] = green / count
        image[place, 2] = blue / count
        matte[place] = hit / count
        for sample in order:
            if faces[p * samples + sample] >= 0:
                depth[place] = distances[p * samples + sample]
                break


def compile_kernels() -> None:
    """Compile all kernels, or read their machine code from disk."""
    for kernel in (cover, aim, expose):
        kernel()
