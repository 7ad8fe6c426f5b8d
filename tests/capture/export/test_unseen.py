"""What the report says of a subject that photographs show in part."""

import dataclasses

import pytest
import torch

from ghgs_capture.export import OutputOptions, write_prediction
from ghgs_capture.export.subject import exported_subject
from ghgs_capture.export.unseen import GUESSED, unseen
from ghgs_capture.verbs.advice import advice_of
from ghgs_lit.rendering import Renderer, render
from ghgs_lit.types import Batch, Prediction
from tests.helpers.splats import body, camera_ring
from tests.helpers.training import Standin

SIZE = 96


def photographed(views: int, shown: tuple[int, ...] = ()) -> tuple[Batch, Prediction]:
    """An ellipsoid in photographs all around, of which those of ``shown`` end at so many rows."""
    gaussians, cameras = body(12000, SIZE), camera_ring(views, SIZE, SIZE)
    drawn = render(gaussians, cameras, background=0.0)
    images, alpha, intrinsics = drawn.image, drawn.alpha[:, :, 0], cameras.intrinsics.clone()
    for view, rows in enumerate(shown):
        # Moved down in its frame, so that the rows below end.
        intrinsics[0, view, 1, 2] += SIZE - rows
        images[0, view] = torch.nn.functional.pad(images[0, view, :, :rows], (0, 0, SIZE - rows, 0))
        alpha[0, view] = torch.nn.functional.pad(alpha[0, view, :rows], (0, 0, SIZE - rows, 0))
    cameras, masks = dataclasses.replace(cameras, intrinsics=intrinsics), alpha > 0.5
    batch = Batch(images=images, masks=masks, cameras=cameras, alpha=alpha)
    return batch, dataclasses.replace(Standin()(batch), gaussians=gaussians)


def said(batch: Batch, prediction: Prediction) -> dict:
    depth = Renderer()(prediction.gaussians, batch.cameras).depth
    return unseen(exported_subject(batch, prediction, Renderer(), OutputOptions()), depth)


def test_what_one_photograph_alone_shows_is_a_guess():
    """All of what two opposite cameras see, little of what eight do."""
    parts = ["0 to 25 %", "25 to 50 %", "50 to 75 %", "75 to 100 %"]
    opposite, ring = said(*photographed(2))["seen_once"], said(*photographed(8))["seen_once"]
    assert list(opposite) == list(ring) == parts
    assert min(opposite.values()) > GUESSED
    assert max(ring.values()) < GUESSED / 2  # at the poles, which cameras around hardly see


def test_a_subject_that_frames_cut_is_said(tmp_path):
    """Six of eight photographs end above its feet: which, where,
    and that the lowest part is a guess."""
    whole = {0, 4}
    batch, prediction = photographed(8, tuple(SIZE if view in whole else SIZE // 2 for view in range(8)))
    found = said(batch, prediction)
    assert found["cut"] == {"bottom": ["1", "2", "3", "5", "6", "7"]}
    assert found["seen_once"]["0 to 25 %"] > GUESSED > found["seen_once"]["75 to 100 %"]
    write_prediction(tmp_path, batch, prediction, Renderer(), OutputOptions(("ply",), frames=0))
    lines = list(advice_of(tmp_path))
    assert "1, 2, 3, 5, 6, 7 end at the subject's bottom: what no photograph shows is missing" in lines
    assert any(line.startswith("at 0 to 25 %") and line.endswith(": a guess") for line in lines)


@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_any_unit_says_the_same(scale):
    batch, prediction = photographed(4)
    extrinsics = batch.cameras.extrinsics.double()
    extrinsics[..., :3, 3] *= scale
    gaussians = dataclasses.replace(
        prediction.gaussians,
        means=prediction.gaussians.means * scale,
        scales=prediction.gaussians.scales * scale,
        metre=torch.tensor([scale]),
    )
    moved = dataclasses.replace(batch, cameras=dataclasses.replace(batch.cameras, extrinsics=extrinsics))
    found = said(moved, dataclasses.replace(prediction, gaussians=gaussians))
    assert found["seen_once"] == pytest.approx(said(batch, prediction)["seen_once"], abs=0.01)
