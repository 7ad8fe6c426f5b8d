"""The measure of part-awareness, against a loop."""

import torch
import torch.nn.functional as F

from ghgs_lit.training.pretext.module import neighbor_shows_part


def test_the_nearest_neighbour_of_another_view_is_asked():
    """Against a loop over pairs with PyTorch's cosine; lengths of features do not count."""
    g = torch.Generator().manual_seed(0)
    features = torch.randn(40, 6, generator=g) * torch.logspace(-3, 3, 40)[:, None]
    parts, views = torch.randint(4, (40,), generator=g), torch.randint(3, (40,), generator=g)
    expected = []
    for i in range(40):
        others = [j for j in range(40) if views[j] != views[i]]
        best = max(others, key=lambda j, i=i: float(F.cosine_similarity(features[i], features[j], dim=0)))
        expected.append(bool(parts[best] == parts[i]))
    found = neighbor_shows_part(features, parts, views)
    assert found.tolist() == expected
    assert 0 < found.float().mean() < 1


def test_without_another_view_nothing_is_right():
    """One view alone, and no patch at all, are defined."""
    one = torch.zeros(3, dtype=torch.long)
    assert not neighbor_shows_part(torch.ones(3, 2), one, one).any()
    assert neighbor_shows_part(torch.ones(0, 2), one[:0], one[:0]).shape == (0,)
