"""Labels of patches, against loops over pixels."""

import dataclasses
import functools

import numpy as np
import pytest
import torch

from ghgs_lit.errors import InputError
from ghgs_lit.geometry.masks import patches_around_subject
from ghgs_lit.method.plan.patches import KeptPatches
from ghgs_lit.training.pretext.labels import PARTS, part_shares, parts_of_points
from ghgs_people.figures.body import BODY_VERTICES, load_body
from ghgs_people.figures.parts import vertex_parts
from tests.helpers.bodies import body_batch

SIZE = 14
scene = functools.cache(body_batch)


def kept_of(batch):
    return KeptPatches(patches_around_subject(batch.masks, SIZE, 0), torch.device("cpu"))


def test_parts_lie_where_a_person_has_them():
    """The rig's left is +x; a swap of sides or a bone of another part would teach it."""
    points = load_body().mean[:BODY_VERTICES]
    names = np.array(PARTS)[vertex_parts()]
    assert set(names) == set(PARTS)
    assert names[points[:, 1].argmax()] == "head"
    assert names[points[:, 0].argmax()] == "left hand"
    assert names[points[:, 0].argmin()] == "right hand"
    heights = {part: points[names == part, 1].mean() for part in PARTS}
    for side in ("left", "right"):
        order = ["head", "chest", "abdomen", "hips", *(f"{side} {p}" for p in ("thigh", "shin", "foot"))]
        assert sorted(order, key=heights.get, reverse=True) == order
        arm = [abs(points[names == f"{side} {p}", 0].mean()) for p in ("upper arm", "forearm", "hand")]
        assert arm == sorted(arm)
    for part in ("upper arm", "forearm", "hand", "thigh", "shin", "foot"):
        assert abs((names == f"left {part}").sum() - (names == f"right {part}").sum()) <= 2


def test_a_point_has_the_part_of_the_nearest_vertex():
    """Against all distances; bodies of another kind have other vertices."""
    vertices = torch.from_numpy(load_body().mean[:BODY_VERTICES])
    g = torch.Generator().manual_seed(0)
    points = vertices[torch.randint(BODY_VERTICES, (50,), generator=g)] + 0.05 * torch.randn(
        50, 3, generator=g
    )
    nearest = (points[:, None].double() - vertices).square().sum(-1).argmin(1)
    assert parts_of_points(points.float(), vertices.float()).tolist() == vertex_parts()[nearest].tolist()
    with pytest.raises(
        InputError, match="vertices of the body: expected those of a body whose parts are known"
    ):
        parts_of_points(points.float(), vertices[:-1].float())


def test_shares_are_those_of_a_patchs_pixels():
    """Each pixel of the scene shows a known vertex."""
    batch, shown = scene(2, 2, 84, 70)
    kept = kept_of(batch)
    shares = part_shares(batch, SIZE)[kept.index]
    expected = torch.zeros(len(kept.index), len(PARTS))
    for n, (image, row, column) in enumerate(zip(kept.image, kept.row, kept.column, strict=True)):
        patch = shown.flatten(0, 1)[image, SIZE * row : SIZE * (row + 1), SIZE * column : SIZE * (column + 1)]
        for vertex in patch[patch >= 0].tolist():
            expected[n, vertex_parts()[vertex]] += 1
    expected /= expected.sum(1, keepdim=True)
    torch.testing.assert_close(shares.sum(1), torch.ones(len(expected)))
    everywhere = torch.zeros(2 * 2 * 6 * 5, dtype=torch.bool)
    everywhere[kept.index] = True
    assert torch.equal(part_shares(batch, SIZE).any(1), everywhere)
    # A vertex is not exactly at its pixel's centre,
    # so that another one may be nearer at a border of parts.
    assert (shares - expected).abs().sum(1).mean() < 0.05


@pytest.mark.parametrize(
    ("missing", "message"), [("depths", "data: expected true depths"), ("body_vertices", "data: ")]
)
def test_photographs_without_labels_are_refused(missing, message):
    """Photographs of real people say nothing about parts."""
    batch, _ = scene(2, 2, 84, 70)
    with pytest.raises(InputError, match=message):
        part_shares(dataclasses.replace(batch, **{missing: None}), SIZE)
