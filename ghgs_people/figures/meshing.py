"""Operations on triangle and quad meshes: normals, subdivision, smoothing, clipping, UV rasterization."""

import numpy as np
import trimesh
from scipy import sparse
from scipy.ndimage import distance_transform_edt


def triangles(quads: np.ndarray) -> np.ndarray:
    """Split quads into triangles.

    Args:
        quads: [m, 4] indices of corners in order.

    Returns:
        [2 m, 3].
    """
    return quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit vertex normals: area-weighted mean of the normals of adjacent faces.

    Args:
        vertices: [n, 3].
        faces: [m, 3], counter-clockwise seen from outside.

    Returns:
        [n, 3]; 0 where normals cancel.
    """
    double_areas = trimesh.triangles.cross(vertices[faces])  # their length is the weight
    return trimesh.geometry.mean_vertex_normals(len(vertices), faces, double_areas)


def smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit vertex normals that are shared by vertices at the same position, such as along UV seams.

    Args:
        vertices: [n, 3]; positions are equal if six decimals agree.
        faces: [m, 3], counter-clockwise seen from outside.

    Returns:
        [n, 3] float32.
    """
    first, merged = trimesh.grouping.unique_rows(vertices, digits=6)
    return vertex_normals(vertices[first].astype(np.float64), merged[faces])[merged].astype(np.float32)


def subdivide(quads: np.ndarray, count: int) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Split each quad into four, at the midpoints of edges and faces.

    Args:
        quads: [m, 4] indices of vertices.
        count: number of vertices.

    Returns:
        The operator [count + edges + m, count] that gives the new vertices,
        and the new quads [4 m, 4].
    """
    edges = np.sort(np.stack([quads, np.roll(quads, -1, 1)], -1).reshape(-1, 2), 1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    mid = count + inverse.reshape(-1, 4)
    centre = count + len(unique) + np.arange(len(quads))
    parts = [[quads[:, i], mid[:, i], centre, mid[:, i - 1]] for i in range(4)]
    fine = np.stack([np.stack(part, -1) for part in parts], 1).reshape(-1, 4)
    total = count + len(unique) + len(quads)
    rows = np.concatenate(
        [np.arange(count), np.repeat(count + np.arange(len(unique)), 2), np.repeat(centre, 4)]
    )
    columns = np.concatenate([np.arange(count), unique.ravel(), quads.ravel()])
    values = np.concatenate([np.ones(count), np.full(2 * len(unique), 0.5), np.full(4 * len(quads), 0.25)])
    return sparse.csr_matrix((values, (rows, columns)), (total, count)), fine


def neighbour_mean(faces: np.ndarray, count: int) -> sparse.csr_matrix:
    """Operator of one step of Laplacian smoothing: half the way to the mean of the neighbours, with a fixed
    border.

    Args:
        faces: [m, c] indices of vertices, triangles or quads.
        count: number of vertices.

    Returns:
        Operator [count, count], rows sum to 1.
    """
    pairs = np.stack([faces, np.roll(faces, -1, 1)], -1).reshape(-1, 2)
    graph = sparse.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (count, count)).tocsr()
    both = graph + graph.T
    links = both.tocoo()
    border = np.zeros(count, bool)
    border[links.row[links.data == 1]] = True
    linked = (both > 0).astype(np.float64)
    keep = sparse.diags(np.where(border, 0.0, 1.0))
    linked = keep @ linked
    degree = np.asarray(linked.sum(1)).ravel()
    scale = np.where(degree > 0, 0.5 / np.where(degree > 0, degree, 1.0), 0.0)
    return sparse.diags(scale) @ linked + sparse.diags(np.where(degree > 0, 0.5, 1.0))


def clip(faces: np.ndarray, field: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Cut a mesh along the zero line of a field and keep the positive side.

    Args:
        faces: [m, 3].
        field: [n] on the vertices, linear between them.

    Returns:
        Faces [k, 3] of new vertices, and for each new vertex two old ones `a`, `b` and the weight `t`
        of `b`: an attribute of the new mesh is `(1 - t) * x[a] + t * x[b]`.
    """
    count = len(field)
    inside = field[faces] >= 0
    number = inside.sum(1)
    whole = faces[number == 3]
    cut = faces[(number == 1) | (number == 2)]
    flags = field[cut] >= 0
    odd = np.where(flags.sum(1) == 1, np.argmax(flags, 1), np.argmin(flags, 1))
    turned = np.take_along_axis(cut, (odd[:, None] + np.arange(3)) % 3, 1)
    apex, left, right = turned.T
    pairs = np.sort(np.concatenate([np.stack([apex, left], 1), np.stack([apex, right], 1)]), 1)
    unique, inverse = np.unique(pairs, axis=0, return_inverse=True)
    on_left, on_right = (count + inverse.ravel()).reshape(2, -1)
    tip = field[apex] >= 0
    parts = [
        whole,
        np.stack([apex, on_left, on_right], 1)[tip],
        np.stack([on_left, left, right], 1)[~tip],
        np.stack([on_left, right, on_right], 1)[~tip],
    ]
    faces = np.concatenate(parts)
    one = field[unique[:, 0]]
    two = field[unique[:, 1]]
    a = np.concatenate([np.arange(count), unique[:, 0]])
    b = np.concatenate([np.arange(count), unique[:, 1]])
    t = np.concatenate([np.zeros(count), one / (one - two)])
    used, faces = np.unique(faces, return_inverse=True)
    return faces.reshape(-1, 3), a[used], b[used], t[used]


def rasterise(uv: np.ndarray, faces: np.ndarray, height: int, width: int) -> tuple[np.ndarray, ...]:
    """Find the face of each texel of a texture.

    Args:
        uv: [n, 2] in [0, 1], origin at the bottom left.
        faces: [m, 3] over the n points.
        height: height of the texture, texels.
        width: width of the texture, texels.

    Returns:
        Flat indices [k] of the covered texels, their face [k] and barycentric coordinates
        [k, 3], and `nearest` [height * width]: for each texel the position among the k of the
        nearest covered one.
    """
    corners = np.stack([uv[faces][..., 0] * width, (1 - uv[faces][..., 1]) * height], -1) - 0.5
    low = np.maximum(np.ceil(corners.min(1) - 1e-6).astype(np.int64), 0)
    high = np.minimum(np.floor(corners.max(1) + 1e-6).astype(np.int64), [width - 1, height - 1])
    size = np.maximum(high - low + 1, 0)
    number = size[:, 0] * size[:, 1]
    face = np.repeat(np.arange(len(faces)), number)
    within = np.arange(len(face)) - np.repeat(np.cumsum(number) - number, number)
    x = low[face, 0] + within % size[face, 0]
    y = low[face, 1] + within // size[face, 0]
    a, b, c = (corners[:, i] for i in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    valid = np.abs(area) > 1e-12
    scale = np.where(valid, 1.0 / np.where(valid, area, 1.0), 0.0)[face]
    dx = x - a[face, 0]
    dy = y - a[face, 1]
    second = (dx * (c - a)[face, 1] - dy * (c - a)[face, 0]) * scale
    third = (dy * (b - a)[face, 0] - dx * (b - a)[face, 1]) * scale
    bary = np.stack([1 - second - third, second, third], 1)
    hit = valid[face] & (bary.min(1) >= -1e-6)
    texels, first = np.unique((y * width + x)[hit], return_index=True)
    covered = np.zeros(height * width, bool)
    covered[texels] = True
    rows, columns = distance_transform_edt(
        ~covered.reshape(height, width), return_distances=False, return_indices=True
    )
    position = np.cumsum(covered) - 1
    nearest = position[(rows * width + columns).ravel()]
    return texels, face[hit][first], bary[hit][first], nearest
