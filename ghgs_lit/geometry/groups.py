"""Groups of the elements of a batch that go through the stages apart, because their sizes differ."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter

import torch
from jaxtyping import Int
from torch import Tensor

from ghgs_lit.types import Batch, DepthBounds, DepthMaps, Gaussians, Points, Prediction


@dataclass(frozen=True)
class Group:
    """The prediction for some elements of a batch, which are indices; the image of each token within them."""

    elements: Int[Tensor, " n"]
    prediction: Prediction
    token_image: Int[Tensor, " t"]

    def in_batch(self, image: Int[Tensor, " m"]) -> Int[Tensor, " m"]:
        """Images of the group as images of the batch."""
        views = self.prediction.depth.shape[1]
        return self.elements[image // views] * views + image % views


def select_elements(
    batch: Batch, bounds: DepthBounds | None, elements: Int[Tensor, " n"]
) -> tuple[Batch, DepthBounds | None]:
    """What the stages read of some elements: photographs, masks, cameras and names, and their bounds."""
    part = Batch(
        batch.images[elements],
        batch.masks[elements],
        batch.cameras[elements],
        subjects=tuple(batch.subjects[i] for i in elements.tolist()) if batch.subjects else (),
        views=tuple(batch.views[i] for i in elements.tolist()) if batch.views else (),
        corners=None if batch.corners is None else batch.corners[elements],
    )
    if bounds is None:
        return part, None
    return part, DepthBounds(bounds.near[elements], bounds.far[elements])


def join_groups(groups: Sequence[Group]) -> Prediction:
    """The prediction for the whole batch, in the order of its elements; maps of all groups have one size."""
    if len(groups) == 1:
        return groups[0].prediction
    order = torch.cat([group.elements for group in groups]).argsort()
    predictions = [group.prediction for group in groups]

    def maps(name: str) -> Tensor:
        return torch.cat([attrgetter(name)(prediction) for prediction in predictions])[order]

    bounds = None
    if predictions[0].depth_maps.bounds is not None:
        bounds = DepthBounds(maps("depth_maps.bounds.near"), maps("depth_maps.bounds.far"))
    whole = DepthMaps(
        *(maps(f"depth_maps.{name}") for name in ("depth", "valid", "confidence")), bounds=bounds
    )
    # Inside a group tokens are in the order of their images; a stable sort keeps the rest of their order.
    by_image = torch.cat([group.in_batch(group.token_image) for group in groups]).argsort(stable=True)
    points = Points(
        pixels=maps("points.pixels"),
        valid=whole.valid,
        tokens=torch.cat([prediction.points.tokens for prediction in predictions])[by_image],
        tokens_valid=torch.cat([prediction.points.tokens_valid for prediction in predictions])[by_image],
    )
    return Prediction(_join_gaussians(groups, order), whole.depth, whole.valid, points, whole)


def _join_gaussians(groups: Sequence[Group], order: Int[Tensor, " b"]) -> Gaussians:
    packed = [
        dataclasses.replace(found, image=group.in_batch(found.image))
        for group in groups
        for found in [group.prediction.gaussians]
    ]
    counts = [count for gaussians in packed for count in gaussians.splits]
    splits = tuple(counts[i] for i in order.tolist())
    names = [f.name for f in dataclasses.fields(Gaussians) if f.name != "splits"]
    joined = {name: torch.cat([getattr(gaussians, name) for gaussians in packed]) for name in names}
    return Gaussians(**joined, splits=splits).select(joined["image"].argsort(stable=True), splits)
