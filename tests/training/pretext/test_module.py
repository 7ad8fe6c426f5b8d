"""The loss of the pretext stage, against PyTorch's own, and a branch that learns."""

import torch
import torch.nn.functional as F

from ghgs_lit.method.encoder.semantic import SemanticOptions
from ghgs_lit.training.pretext.labels import PARTS
from ghgs_lit.training.pretext.module import Pretext, cross_entropy
from tests.helpers.bodies import body_batch


def branch():
    torch.manual_seed(0)
    return SemanticOptions(width=32, depth=1, heads=2, channels=8).build(14)


def test_patches_without_a_part_do_not_count():
    """Against PyTorch's cross-entropy of the others; none at all is a loss of 0."""
    g = torch.Generator().manual_seed(0)
    logits, shares = torch.randn(10, 5, generator=g), torch.rand(10, 5, generator=g)
    shares /= shares.sum(1, keepdim=True)
    shares[::3] = 0
    known = shares.any(1)
    found = cross_entropy(logits.log_softmax(1), shares)
    torch.testing.assert_close(found, F.cross_entropy(logits[known], shares[known]))
    assert cross_entropy(logits.log_softmax(1), 0 * shares) == 0


def test_a_branch_has_a_channel_for_each_part():
    """Another number would count some parts as others."""
    assert branch().parts == len(PARTS)


def test_a_branch_learns_a_scene():
    """The loss must reach every parameter of the branch and fall."""
    batch, _ = body_batch(1, 2, 56, 42)
    model = Pretext(branch())
    optimizer = torch.optim.Adam(model.parameters(), lr=5e-3)
    losses = []
    for _ in range(20):
        loss = cross_entropy(*model(batch)[:2])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert all(p.grad is not None and p.grad.any() for p in model.parameters())
    assert losses[-1] < 0.6 * losses[0]
