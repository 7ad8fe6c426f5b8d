"""Removes lens distortion from photographs and masks, as OpenCV's ``undistort`` does.

Pixel centres are at integers in this file, as in the calibration. OpenCV itself is not a dependency; kornia
has its camera model.
"""

import numpy as np
import torch
import torch.nn.functional as F
from kornia.geometry.calibration import distort_points

# Pixels between evaluations of the model; it is interpolated linearly, with errors below 0.01 px.
_STEP = 8


def undistorting_grid(
    intrinsics: np.ndarray, distortion: np.ndarray, height: int, width: int
) -> torch.Tensor:
    """Where each pixel of the undistorted image lies in the photograph.

    Args:
        intrinsics: [3, 3] in pixels; the undistorted image keeps them.
        distortion: k1 k2 p1 p2, or k1 k2 p1 p2 k3.
        height, width: size of the photograph in pixels.

    Returns:
        [1, h, w, 2] for ``grid_sample``.
    """
    counts = [max(2, -(-side // _STEP) + 1) for side in (height, width)]
    knots = [torch.linspace(0, side - 1, n) for side, n in zip((height, width), counts, strict=True)]
    rows, columns = torch.meshgrid(*knots, indexing="ij")
    matrix, coefficients = (torch.from_numpy(a).float()[None] for a in (intrinsics, distortion))
    places = distort_points(torch.stack((columns, rows), -1).reshape(1, -1, 2), matrix, coefficients)
    # Pixel j, centred at integer j, is at (2 j + 1) / w - 1 with align_corners=False.
    grid = ((2 * places + 1) / torch.tensor([width, height]) - 1).reshape(1, *counts, 2)
    dense = F.interpolate(grid.permute(0, 3, 1, 2), (height, width), mode="bilinear", align_corners=True)
    return dense.permute(0, 2, 3, 1)


def undistort(image: np.ndarray, mask: np.ndarray, grid: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Resample bilinearly; black and empty outside the photograph.

    Args:
        image: [h, w, 3] uint8.
        mask: [h, w] bool; pixels that are more than half covered stay in the mask.
        grid: from :func:`undistorting_grid`.
    """
    layers = np.concatenate((image, 255 * mask[..., None].astype(np.uint8)), -1)
    stacked = torch.from_numpy(layers).permute(2, 0, 1)[None].float()
    sampled = F.grid_sample(stacked, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    sampled = sampled[0].permute(1, 2, 0).numpy()
    return np.round(sampled[..., :3]).astype(np.uint8), sampled[..., 3] > 127.5
