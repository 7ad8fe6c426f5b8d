"""Undistortion of images with kornia's lens models, equivalent to OpenCV's ``undistort`` and
``fisheye``."""

import numpy as np
import torch
import torch.nn.functional as F

# Pixels between evaluations of the model; linear interpolation in between has errors below 0.01 px.
_STEP = 8
_OUTSIDE = 4.0  # grid position outside the image, which spans -1 to 1
_RADII = 4096  # number of radii at which a lens model is checked for monotonicity


def undistorting_grid(
    intrinsics: np.ndarray, distortion: np.ndarray, height: int, width: int, fisheye: bool = False
) -> torch.Tensor:
    """Sampling grid that maps pixels of the undistorted image to the distorted one.

    The formulas are those of OpenCV's camera model and of its fisheye model (Kannala and
    Brandt, PAMI 2006).

    Args:
        intrinsics: K [3, 3] in pixels, also of the undistorted image.
        distortion: k1 k2 p1 p2 and up to ten more of OpenCV's model; with ``fisheye`` k1 to k4.
        height: height of both images in pixels.
        width: width of both images in pixels.
        fisheye: whether the coefficients are those of the fisheye model.

    Returns:
        Positions [1, h, w, 2] float32 for ``grid_sample`` with ``align_corners=False``. Beyond the
        radius at which the model stops increasing, and would show parts of the image twice,
        positions lie outside.
    """
    # Imported late: importing kornia takes longer than reading images without distortion.
    from kornia.geometry.calibration import distort_points
    from kornia.geometry.camera.distortion_kannala_brandt import distort_points_kannala_brandt

    counts = [max(2, -(-side // _STEP) + 1) for side in (height, width)]
    knots = [
        torch.linspace(0.5, side - 0.5, n, dtype=torch.float64)
        for side, n in zip((height, width), counts, strict=True)
    ]
    rows, columns = torch.meshgrid(*knots, indexing="ij")
    pixels = torch.stack((columns, rows), -1).reshape(-1, 2)
    matrix, coefficients = (torch.from_numpy(np.asarray(a, np.float64)) for a in (intrinsics, distortion))
    if fisheye:
        scale = matrix[[0, 1], [0, 1]]
        middle = matrix[:2, 2]
        params = torch.cat((scale, middle, coefficients))
        places = distort_points_kannala_brandt((pixels - middle) / scale, params)
    else:
        places = distort_points(pixels[None], matrix[None], coefficients[None])[0]
    grid = (2 * places / places.new_tensor([width, height]) - 1).reshape(1, *counts, 2).float()
    dense = F.interpolate(grid.permute(0, 3, 1, 2), (height, width), mode="bilinear", align_corners=True)
    columns, rows = np.arange(width) + 0.5, np.arange(height) + 0.5
    focal, middle = np.diag(intrinsics)[:2], intrinsics[:2, 2]
    radii = np.hypot(((rows - middle[1]) / focal[1])[:, None], (columns - middle[0]) / focal[0])
    is_beyond = torch.from_numpy(radii > _range(distortion, fisheye, radii.max()))
    return dense.permute(0, 2, 3, 1).masked_fill(is_beyond[..., None], _OUTSIDE)


def _range(distortion: np.ndarray, fisheye: bool, largest: float) -> float:
    """Radius on the plane z = 1 up to which a lens model increases, at most ``largest``."""
    radii = np.linspace(0, largest, _RADII)
    k = np.zeros(14)
    k[: len(distortion)] = distortion
    if fisheye:
        inner = np.arctan(radii)
        bent = inner * np.polynomial.Polynomial([1, *k[:4]])(inner**2)
    else:
        inner = radii**2
        below = np.polynomial.Polynomial([1, *k[5:8]])(inner)
        bent = radii * np.polynomial.Polynomial([1, k[0], k[1], k[4]])(inner) / below
    turns = np.flatnonzero(np.diff(bent) <= 0)
    return radii[turns[0]] if len(turns) else largest


def undistort(image: np.ndarray, matte: np.ndarray, grid: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Resample an image and its matte bilinearly.

    Args:
        image: [h, w, 3] uint8.
        matte: [h, w] uint8.
        grid: from :func:`undistorting_grid`.

    Returns:
        Image and matte, uint8; 0 outside the original image.
    """
    layers = np.concatenate((image, matte[..., None]), -1)
    stacked = torch.from_numpy(layers).permute(2, 0, 1)[None].float()
    sampled = F.grid_sample(stacked, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    sampled = np.round(sampled[0].nan_to_num().permute(1, 2, 0).numpy()).astype(np.uint8)
    return sampled[..., :3], sampled[..., 3]
