"""The matting network: what it sees, and that a result depends on its photograph alone."""

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from ghgs_lit.data.matting import FARTHEST, MattingNetwork, _insideness, _near


@pytest.fixture
def network():
    """With random weights also in its last layer."""
    torch.manual_seed(0)
    found = MattingNetwork().eval()
    torch.nn.init.normal_(found.out.weight, std=0.3)
    return found


def photographs(count=2, height=45, width=38):
    rng = torch.Generator().manual_seed(1)
    mattes = torch.zeros(count, height, width)
    for i in range(count):
        mattes[i, 8 + i : 38, 10 : 25 + 3 * i] = 1
    return torch.rand(count, 3, height, width, generator=rng), mattes


def test_a_new_network_leaves_everything():
    images, mattes = photographs()
    found, subjects = MattingNetwork().eval()(images, mattes)
    assert torch.equal(found, mattes)
    assert torch.equal(subjects, images * mattes[:, None])


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
    """Where the matte is 1, the photograph shows nothing but the subject."""
    images, mattes = photographs()
    torch.nn.init.zeros_(network.out.weight[:1])
    found, subjects = network(images, mattes)
    sure = (found == 1)[:, None].expand_as(images)
    assert sure.any()
    assert torch.equal(subjects[sure], images[sure])


def test_training_pulls_from_beyond_0_and_1(network):
    """Mattes are cut off in evaluation alone, so that every error has a gradient."""
    images, mattes = photographs()
    found, _ = network.train()(images, mattes)
    assert found.min() < 0 or found.max() > 1
    (found - mattes).abs().sum().backward()
    assert all(weight.grad.isfinite().all() for weight in network.parameters())


def test_insideness_is_the_distance_from_the_outline():
    """Which runs half-way between pixels; found by going through all pairs."""
    mask = np.random.default_rng(0).uniform(size=(14, 11)) < 0.5
    places = np.argwhere(np.ones_like(mask))
    apart = cdist(places, places)
    apart[mask.ravel()[:, None] == mask.ravel()] = np.inf
    expected = (apart.min(1).reshape(mask.shape) - 0.5) * np.where(mask, 1, -1) / FARTHEST
    np.testing.assert_allclose(_insideness(mask), expected.clip(-1, 1), atol=1e-6)


@pytest.mark.parametrize("value", [False, True])
def test_without_an_outline_all_is_far_from_it(value):
    assert (_insideness(np.full((3, 4), value)) == (1 if value else -1)).all()


def test_colors_nearby_are_weighted_means():
    """Of one colour on each side: that colour wherever something weighs;
    black, not NaN, elsewhere."""
    weight = torch.zeros(1, 1, 12, 12)
    weight[..., :6] = 0.7
    color = torch.tensor([0.2, 0.5, 0.9])[None, :, None, None]
    found = _near(torch.cat((color * weight, weight), 1), 3, torch.Size((48, 48)))
    torch.testing.assert_close(found[..., :20], color.expand(1, 3, 48, 20), atol=1e-3, rtol=0)
    assert (found[..., 40:] == 0).all()


def test_colors_do_not_train_the_matte(network):
    """A matte that lets in more of the background would be the easiest way to other colours."""
    images, mattes = photographs()
    found, subjects = network.train()(images, mattes)
    colors = (subjects / found[:, None]).movedim(1, -1)[found > 0.2]
    colors.sum().backward()
    gradient = network.out.bias.grad.abs()
    assert gradient[1:].min() > 1
    assert gradient[0] < 1e-3
