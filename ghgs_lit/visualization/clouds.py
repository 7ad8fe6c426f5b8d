"""Predicted points and bodies as coloured point clouds, for a viewer in 3D."""

import torch
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.types import Batch, Prediction

BODY_COLOR = (0.25, 0.5, 0.95)

Cloud = tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]


def clouds(batch: Batch, prediction: Prediction, element: int, limit: int = 6000) -> dict[str, Cloud]:
    """Point clouds of one subject.

    ``points``: unprojected pixels in their colours; ``body``: body vertices, where the data
    has them; ``points_and_body``: both, whose distance the Chamfer term measures. Empty
    clouds are left out.

    Args:
        batch: Photographs, masks and bodies are read.
        prediction: Of that batch.
        element: Number of the subject in the batch.
        limit: Largest number of points and of vertices.

    Returns:
        Positions [n, 3] in metres and colours [n, 3] in [0, 1] by name.
    """
    valid = prediction.points.valid[element] & batch.masks[element]
    colors = batch.images[element].movedim(1, -1)
    parts = {"points": (prediction.points.pixels[element][valid], colors[valid])}
    if batch.body_vertices is not None:
        body = batch.body_vertices[element]
        parts["body"] = (body, body.new_tensor(BODY_COLOR).expand(len(body), 3))
    parts = {name: _thinned(cloud, limit) for name, cloud in parts.items()}
    if "body" in parts:
        pairs = zip(parts["points"], parts["body"], strict=True)
        parts["points_and_body"] = tuple(torch.cat(pair) for pair in pairs)
    return {name: cloud for name, cloud in parts.items() if len(cloud[0])}


def _thinned(cloud: Cloud, limit: int) -> Cloud:
    positions, colors = (part.detach().float().cpu() for part in cloud)
    finite = positions.isfinite().all(-1)
    positions = positions[finite]
    colors = colors[finite].nan_to_num(0).clamp(0, 1)
    step = max(1, -(-len(positions) // limit))
    return positions[::step], colors[::step]
