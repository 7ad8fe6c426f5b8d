"""Rays of a silhouette's cells against the visual hull of others."""

import numpy as np
import pytest

from ghgs_lit.geometry.silhouettes import HullSearch, Silhouette


def camera(turn, cells):
    """Intrinsics of a photograph of ``cells`` x ``cells``, 4 m from the origin, turned around it."""
    sine, cosine = np.sin(turn), np.cos(turn)
    extrinsics = np.eye(4)
    extrinsics[:3] = [[cosine, 0, sine, 0], [0, 1, 0, 0], [-sine, 0, cosine, 4]]
    return np.array([[2 * cells, 0, cells / 2], [0, 2 * cells, cells / 2], [0, 0, 1.0]]), extrinsics


@pytest.mark.parametrize(("row", "agrees"), [(24, True), (19, False)])
def test_rays_pass_the_middle_of_cells(row, agrees):
    """Cells as large as eight of the others' hull, above whose row the ray through their corner lies."""
    mask = np.zeros((8, 8), bool)
    mask[3, 3:5] = True
    others = []
    for turn in (1.2, -1.2):
        fine = np.zeros((64, 64), bool)
        fine[row + 3 : row + 6] = True
        others.append(Silhouette(fine, *camera(turn, 64)))
    silhouettes = [Silhouette(mask, *camera(0, 8)), *others]
    assert HullSearch().shares(silhouettes)[0] == agrees
