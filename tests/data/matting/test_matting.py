"""Matting: the network alone, and refined crops of captures with inaccurate masks."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter, zoom

from ghgs_capture import Capture, crops
from ghgs_lit.data import matting
from ghgs_lit.data.matting import MattingNetwork, _insideness, _near, refine_matte
from ghgs_lit.geometry.masks import signed_distance
from tests.helpers.figures import Figure


@pytest.fixture
def network():
    """A network with large random weights in its last layer."""
    torch.manual_seed(0)
    found = MattingNetwork().eval()
    torch.nn.init.normal_(found.out.weight, std=0.3)
    torch.nn.init.zeros_(found.out.bias)
    return found


def photographs(count=2, height=45, width=38):
    rng = torch.Generator().manual_seed(1)
    mattes = torch.zeros(count, height, width)
    for i in range(count):
        mattes[i, 8 + i : 38, 10 : 25 + 3 * i] = 1
    return torch.rand(count, 3, height, width, generator=rng), mattes


@pytest.mark.parametrize("size", [(1, 1), (3, 50), (45, 38), (64, 64)])
def test_any_size_gives_shares_and_colors_between_0_and_1(network, size):
    images, mattes = torch.rand(1, 3, *size), torch.rand(1, *size)
    found, subjects = network(images, mattes)
    assert found.shape == (1, *size)
    assert subjects.shape == (1, 3, *size)
    assert ((found >= 0) & (found <= 1)).all()
    assert ((subjects >= 0) & (subjects <= found[:, None])).all()
    assert (found != mattes).any()


def test_photographs_do_not_depend_on_their_batch_mates(network):
    images, mattes = photographs()
    together = network(images, mattes)
    for i in range(2):
        alone = network(images[i : i + 1], mattes[i : i + 1])
        for part, whole in zip(alone, together, strict=True):
            torch.testing.assert_close(part[0], whole[i], atol=1e-5, rtol=0)


def test_colors_change_at_the_rim_alone(network):
    """Where the matte is 1, the image shows only the subject and keeps its colours."""
    images, mattes = photographs()
    torch.nn.init.zeros_(network.out.weight[:1])
    found, subjects = network(images, mattes)
    sure = (found == 1)[:, None].expand_as(images)
    assert sure.any()
    assert torch.equal(subjects[sure], images[sure])


@pytest.mark.parametrize("value", [False, True])
def test_without_an_outline_all_is_far_from_it(value):
    assert (_insideness(np.full((3, 4), value)) == (1 if value else -1)).all()


def test_colors_nearby_are_weighted_means():
    """The mean of a single colour is that colour, and black instead of NaN without weights."""
    weight = torch.zeros(1, 1, 12, 12)
    weight[..., :6] = 0.7
    color = torch.tensor([0.2, 0.5, 0.9])[None, :, None, None]
    found = _near(torch.cat((color * weight, weight), 1), 3, torch.Size((48, 48)))
    torch.testing.assert_close(found[..., :20], color.expand(1, 3, 48, 20), atol=1e-3, rtol=0)
    assert (found[..., 40:] == 0).all()


HEIGHT, WIDTH = 216, 180


@pytest.fixture(scope="module")
def scene():
    """A textured ellipse in front of a cloudy background: image, colours on black, matte."""
    rng = np.random.default_rng(3)
    v, u = np.mgrid[: 4 * HEIGHT, : 4 * WIDTH] / 4
    inside = ((u - 93) / 51) ** 2 + ((v - 105) / 81) ** 2 < 1
    alpha = inside.reshape(HEIGHT, 4, WIDTH, 4).mean((1, 3))
    subject, behind = (
        0.5 * zoom(rng.uniform(size=(cells, cells, 3)), (HEIGHT / cells, WIDTH / cells, 1), order=1) + offset
        for cells, offset in ((12, [0.3, 0.0, 0.1]), (6, [0.1, 0.4, 0.5]))
    )
    premultiplied = subject * alpha[..., None]
    photograph = premultiplied + behind * (1 - alpha[..., None])
    return tuple(
        (255 * part.clip(0, 1)).round().astype(np.uint8) for part in (photograph, premultiplied, alpha)
    )


def masks_of(alpha):
    """Masks by name: the exact one, and wrong ones that are off by up to 2.5 pixels or have a hole 6 pixels
    wide."""
    mask = alpha > 127
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    bumps = gaussian_filter(np.random.default_rng(1).standard_normal(mask.shape), 3)
    distance = signed_distance(mask)
    return {
        "exact": mask,
        "grown": distance > -2,
        "shrunk": distance > 2,
        "ragged": distance + 2.5 * bumps / np.abs(bumps).max() > 0,
        "holed": mask & ((v - 90) ** 2 + (u - 90) ** 2 >= 9),
    }


def error(matte, alpha):
    return np.abs(matte.astype(float) - alpha).sum() / alpha.sum()


@pytest.mark.parametrize("name", ["exact", "grown", "shrunk", "ragged", "holed"])
def test_the_photograph_mends_the_mask(scene, name):
    """The refined matte has less than 0.4 of the mask's error, and its colours less than 0.65."""
    photograph, premultiplied, alpha = scene
    mask = (255 * masks_of(alpha)[name]).astype(np.uint8)
    subject, matte = refine_matte(photograph, mask, 4)
    assert error(matte, alpha) < 0.4 * error(mask, alpha)
    given = photograph * (mask[..., None] / 255)
    assert error(subject, premultiplied) < 0.65 * error(given, premultiplied)
    assert (subject[matte == 0] == 0).all()


def test_far_from_the_outline_the_mask_decides(scene):
    """Pixels farther from the outline than the limit stay as in the mask, such as the middle of a wide
    hole."""
    photograph, _, alpha = scene
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    place = np.hypot(v - 105, u - 93)
    mask = (255 * ((alpha > 127) & (place >= 9))).astype(np.uint8)
    _, matte = refine_matte(photograph, mask, 4)
    assert (matte[place < 4] == 0).all()
    far = np.abs(signed_distance(mask > 0)) + 0.5 > 4  # distance to the nearest pixel of the other side
    assert (matte[far] == mask[far]).all()
    assert (matte != mask)[~far].any()


def test_a_subject_that_the_border_cuts_stays_whole_there(scene):
    """The image border does not count as an outline."""
    photograph, _, alpha = (part[:150, :120] for part in scene)
    _, matte = refine_matte(photograph, np.where(alpha > 127, 255, 0).astype(np.uint8), 4)
    assert (matte[-1][alpha[-1] == 255] > 240).all()
    assert error(matte, alpha) < 0.02


@pytest.mark.parametrize("value", [0, 255])
@pytest.mark.parametrize("size", [(2, 2), (2, 7), (9, 9)])
def test_masks_without_an_outline_stay(value, size):
    image = np.random.default_rng(0).integers(0, 255, (*size, 3)).astype(np.uint8)
    mask = np.full(size, value, np.uint8)
    subject, matte = refine_matte(image, mask, 4)
    assert (matte == mask).all()
    assert np.abs(subject.astype(int) - image * (value // 255)).max() <= 3


@pytest.mark.parametrize("height", [128, 512])
def test_mattes_are_found_at_twice_the_size_of_crops(monkeypatch, tmp_path, height):
    """Mattes are estimated at twice the crop size, or at the image's size if that is smaller, with limits in
    pixels of the crops."""
    calls = []

    def record(image, matte, pixels):
        calls.append((image.shape[:2], matte.shape, pixels))
        return image, matte

    monkeypatch.setattr(matting, "refine_matte", record)
    figure = Figure(height=height, width=height * 3 // 4)
    taken = Capture.read(tmp_path, figure.write(tmp_path))
    cut = [int(1 / crops.SHARE * (np.ptp(np.nonzero(one.mask)[0]) + 1)) for one in taken.photographs]
    taken.batch((112, 84), 4)
    for (size, same, pixels), rows in zip(calls, cut, strict=True):
        assert size == same
        assert size[0] == pytest.approx(min(rows, 2 * 112), abs=2)
        assert pixels == 4 * size[0] / 112


def test_crops_of_wrong_masks_hold_the_subject_alone(tmp_path):
    """Crops of larger images contain almost no background, and cameras stay those of the given masks."""
    figure = Figure(height=256, width=192)
    exact = Capture.read(tmp_path, figure.write(tmp_path))
    grown = tuple(
        dataclasses.replace(
            one, matte=(255 * (np.abs(signed_distance(one.mask)) <= 3.5)).astype(np.uint8) | one.matte
        )
        for one in exact.photographs
    )
    wrong = dataclasses.replace(exact, photographs=grown)
    right, given, refined = exact.batch((112, 84)), wrong.batch((112, 84)), wrong.batch((112, 84), 4)
    assert (refined.images[0].movedim(1, -1)[refined.alpha[0] == 0] == 0).all()
    assert (refined.cameras.intrinsics == given.cameras.intrinsics).all()
    assert refined.alpha.sum() < given.alpha.sum() - 0.6 * (given.alpha.sum() - right.alpha.sum())
    assert ((refined.alpha >= 0.5) == refined.masks).all()


def test_a_matte_that_loses_the_subject_is_refused(monkeypatch, tmp_path):
    """The mask stays unchanged, and a warning names the image."""
    figure = Figure()
    taken = Capture.read(tmp_path, figure.write(tmp_path))
    monkeypatch.setattr(matting, "refine_matte", lambda image, matte, pixels: (0 * image, 0 * matte))
    with pytest.warns(UserWarning, match="refine_masks: expected colours of cam") as warned:
        found = taken.batch((56, 42), 4)
    assert len(warned) == len(taken.photographs)
    assert "cam0 that tell the subject" in str(warned[0].message)
    given = taken.batch((56, 42))
    assert (found.alpha - given.alpha).abs().mean() < 0.01
    assert (found.images - given.images).abs().mean() < 0.01


def test_colors_that_say_nothing_leave_the_subject():
    """A subject that looks like its background keeps nearly all of its mask."""
    mask = np.zeros((96, 64), np.uint8)
    mask[16:80, 28:36] = 255
    _, matte = refine_matte(np.full((96, 64, 3), 120, np.uint8), mask, 4)
    assert error(matte, mask) < 0.2
