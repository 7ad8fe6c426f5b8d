"""Feature exchange between neighbouring pixels, against SciPy's correlation of whole images."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.signal import correlate

from ghgs_lit.extents import extents
from ghgs_lit.method.rounds.exchange import Exchange, Windows

HEIGHT, WIDTH, KNOWN, CHANNELS = 13, 17, 6, 3


def scene(masks):
    """The Gaussians of some of the subject's pixels, as with a skip preset, and their batch."""
    image, row, column = torch.nonzero(masks, as_tuple=True)
    raw = SimpleNamespace(image=image, pixel=row * WIDTH + column, real=None)
    batch = SimpleNamespace(masks=masks[None], extents=extents(masks))
    return raw, batch


def blobs(seed=0):
    """Subjects of unequal sizes, one in a corner and one at the opposite border."""
    masks = torch.zeros(3, HEIGHT, WIDTH, dtype=torch.bool)
    masks[0, :5, :4] = masks[1, 3:, 9:] = masks[2, 5:8, 2:15] = True
    return masks & (torch.rand(masks.shape, generator=torch.Generator().manual_seed(seed)) < 0.8)


def trained(seed=0):
    torch.manual_seed(seed)
    exchange = Exchange(KNOWN, CHANNELS).double()
    torch.nn.init.normal_(exchange.hear.weight)
    return exchange


def expected(exchange, raw, known):
    """The definition: maps of whole images, SciPy's correlation, no windows."""
    with torch.no_grad():
        told = exchange.tell(known).numpy()
    maps = np.zeros((3, HEIGHT * WIDTH, CHANNELS))
    maps[raw.image.numpy(), raw.pixel.numpy()] = told
    maps = maps.reshape(3, HEIGHT, WIDTH, CHANNELS)
    kernels, biases = (x.detach().numpy() for x in (exchange.across.weight, exchange.across.bias))
    found = np.stack(
        [
            [
                sum(correlate(m[..., c], kernel[c], "same", "direct") for c in range(CHANNELS)) + bias
                for kernel, bias in zip(kernels, biases, strict=True)
            ]
            for m in maps
        ]
    )
    rows = found[raw.image.numpy(), :, raw.pixel.numpy() // WIDTH, raw.pixel.numpy() % WIDTH]
    hear = exchange.hear.weight.detach().numpy(), exchange.hear.bias.detach().numpy()
    return known.numpy() + np.maximum(rows, 0) @ hear[0].T + hear[1]


@pytest.mark.parametrize(
    ("filled", "shape"), [([0, 1, 2], (3, 10, 13)), ([1], (3, 10, 8)), ([], (3, 1, 1))], ids=str
)
def test_windows_give_what_whole_images_give(filled, shape):
    """Also for images without a subject."""
    masks = torch.zeros(3, HEIGHT, WIDTH, dtype=torch.bool)
    masks[filled] = blobs()[filled]
    raw, batch = scene(masks)
    known, exchange = torch.randn(len(raw.image), KNOWN, dtype=torch.float64), trained()
    windows = Windows.of(raw, batch)
    assert windows.shape == shape
    found = exchange(known, windows).detach().numpy()
    assert found.shape == known.shape
    assert np.allclose(found, expected(exchange, raw, known), rtol=0, atol=1e-12)


def test_untrained_it_adds_nothing():
    raw, batch = scene(blobs())
    known = torch.randn(len(raw.image), KNOWN)
    assert torch.equal(Exchange(KNOWN, CHANNELS)(known, Windows.of(raw, batch)), known)
