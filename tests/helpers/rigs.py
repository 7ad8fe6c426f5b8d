"""A calibration of four cameras with lens distortion, in OpenCV's conventions."""

import cv2
import numpy as np

SIZE = (854, 640)
POINTS = np.random.default_rng(1).uniform([-0.4, 0.0, -0.4], [0.4, 1.8, 0.4], (12, 3))


def rig() -> dict[str, dict[str, np.ndarray]]:
    """K, D, R and T of cameras by name, with pixel centres at integers; the fixtures have the same
    cameras."""
    found = {}
    for i in range(4):
        angle = 1.4 * i
        eye = np.array([2.5 * np.sin(angle), 1.2 + 0.1 * i, 2.5 * np.cos(angle)])
        forward = np.array([0, 0.9, 0]) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 1, 0])
        right /= np.linalg.norm(right)
        rotation = np.stack((right, np.cross(forward, right), forward))
        intrinsics = np.array([[1000 + 9 * i, 0, 310 + i], [0, 1003 + 9 * i, 420 - i], [0, 0, 1.0]])
        distortion = np.array([0.05 - 0.02 * i, -0.03, 0.001, -0.002 * i, 0.01])
        found[f"cam_{i:02d}"] = {"K": intrinsics, "D": distortion, "R": rotation, "T": -rotation @ eye}
    return found


def opencv_pixels(points, rotation, translation, intrinsics, distortion, fisheye=False) -> np.ndarray:
    """Pixels [n, 2] of world points by OpenCV, with the pixel centres of ``intrinsics``."""
    rvec = cv2.Rodrigues(rotation)[0]
    if fisheye:
        return cv2.fisheye.projectPoints(points[:, None], rvec, translation, intrinsics, distortion)[0][:, 0]
    distortion = np.asarray(distortion, np.float64) if len(distortion) else np.zeros(4)
    return cv2.projectPoints(points, rvec, translation, intrinsics, distortion)[0][:, 0]
