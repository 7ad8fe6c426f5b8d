"""A painted ellipsoid that moves in front of cameras that stand still."""

import dataclasses

import torch
from scipy.spatial.transform import Rotation

from ghgs_lit.evaluation.baselines import splats_at
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.types import Batch, DepthMaps, Points, Prediction
from tests.helpers.scenes import CENTER, ellipsoid, ring

#: Of the inputs and of a view between two of them.
AROUND = ring(1, 8, 112, 112)
INPUTS, BETWEEN = AROUND[:, ::2], AROUND[:, 1:2]


def motion(shift=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0)):
    """The rigid motion [4, 4] of a subject that is shifted by metres and turned about
    its centre."""
    matrix = torch.eye(4)
    matrix[:3, :3] = torch.from_numpy(Rotation.from_rotvec(turn).as_matrix()).float()
    matrix[:3, 3] = CENTER - matrix[:3, :3] @ CENTER + torch.tensor(shift)
    return matrix


def photographed(cameras, moved):
    """Images, masks and depths of the subject after a motion; its paint varies over some 30 cm."""
    cameras = dataclasses.replace(cameras, extrinsics=cameras.extrinsics @ moved)
    masks, depths = ellipsoid(cameras)
    points = unproject_maps(depths, cameras)
    colors = 0.5 + 0.4 * torch.sin(20 * points + 5 * points.roll(1, -1) + torch.tensor([0.0, 1.0, 2.0]))
    return colors.movedim(-1, -3) * masks[..., None, :, :], masks, depths


def instant(moved, cameras=INPUTS):
    """The batch of an instant, with true depths."""
    images, masks, depths = photographed(cameras, moved)
    views = (tuple(map(str, range(cameras.extrinsics.shape[1]))),)
    return Batch(images, masks, cameras, depths=depths, subjects=("moving",), views=views)


def at_true_depth(batch):
    """The prediction of splats at the true depths."""
    gaussians = splats_at(batch, batch.depths, batch.masks, sigma=0.6)
    depth = torch.where(batch.masks, batch.depths, 1.0)
    none = torch.zeros(0, dtype=torch.long)
    points = Points(unproject_maps(depth, batch.cameras), batch.masks, torch.zeros(0, 3), none.bool(), none)
    return Prediction(gaussians, depth, batch.masks, points, DepthMaps(depth, batch.masks, depth))
