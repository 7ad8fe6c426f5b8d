"""A batch of the built-in body at rest: the depth of a pixel is that of its nearest vertex."""

import torch

from ghgs_lit.geometry.projection import project
from ghgs_lit.types import Batch
from ghgs_people.figures.body import BODY_VERTICES, load_body
from tests.helpers.cameras import camera_ring


def body_batch(batch=1, views=4, height=112, width=84):
    """The batch, and the vertex visible in each pixel [B, V, H, W], -1 for none."""
    body = load_body()
    vertices = torch.from_numpy(body.rest(body.bodies[0])[0][:BODY_VERTICES]).float()
    place = {"center": (0.0, 0.85, 0.0), "raised": 0.2, "radius": 2.5, "turn": 20.0}
    focal, principal = (1.1 * height, 1.1 * height), (width / 2, height / 2)
    cameras = camera_ring(views, height, width, batch, focal, principal, **place)
    shown = torch.full((batch, views, height, width), -1)
    depths = torch.zeros(batch, views, height, width)
    for b in range(batch):
        for v in range(views):
            pixels, z = project(vertices, cameras.intrinsics[b, v], cameras.extrinsics[b, v])
            columns, rows = pixels.floor().long().unbind(-1)
            for vertex in z.argsort(descending=True).tolist():  # the nearest is written last
                row, column = int(rows[vertex]), int(columns[vertex])
                if 0 <= row < height and 0 <= column < width:
                    shown[b, v, row, column] = vertex
                    depths[b, v, row, column] = z[vertex]
    masks = shown >= 0
    g = torch.Generator().manual_seed(0)
    images = torch.rand(batch, views, 3, height, width, generator=g) * masks[:, :, None]
    return Batch(images, masks, cameras, body_vertices=[vertices] * batch, depths=depths), shown
