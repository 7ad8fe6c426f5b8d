"""The kernel that compares Gaussians with photographs against plain PyTorch."""

import dataclasses

import pytest
import torch

from ghgs_lit.method.rounds.observation import observe
from tests.helpers.kernels import plain_pytorch
from tests.helpers.scenes import make_batch, with_soft_rims
from tests.method.rounds.test_observation import splats


def in_plain_pytorch(gaussians, batch):
    with plain_pytorch():
        return observe(gaussians, batch)


@pytest.mark.parametrize(("b", "v", "height", "width"), [(2, 4, 42, 84), (1, 2, 56, 56), (3, 5, 70, 42)])
@pytest.mark.parametrize("spread", [0.0, 0.3, 3.0])
def test_the_kernel_sees_what_plain_pytorch_does(b, v, height, width, spread):
    """Also at the border, outside of images and behind cameras; one image shows no subject."""
    batch = with_soft_rims(make_batch(b, v, height, width))
    batch.masks[-1, 0] = False
    gaussians = splats(batch)
    moved = torch.randn(gaussians.means.shape, generator=torch.Generator().manual_seed(1)) * spread
    gaussians = dataclasses.replace(gaussians, means=gaussians.means + moved)
    found, expected = observe(gaussians, batch), in_plain_pytorch(gaussians, batch)
    # On the border rounding decides who is seen.
    same = found[..., 9] == expected[..., 9]
    assert same.float().mean() > 0.999
    torch.testing.assert_close(found[same], expected[same], atol=2e-3, rtol=0)
    assert (found - expected)[same].abs().mean() < 1e-5
    assert (expected[..., 9] == 0).any() == (spread > 0.2)


def test_the_number_of_threads_changes_no_bit():
    batch, threads = make_batch(2, 4, 112, 112), torch.get_num_threads()
    gaussians, results = splats(batch), []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            results.append(observe(gaussians, batch))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(*results)
