"""Splats of tiles against gsplat's PyTorch functions, and buffers whose capacity always suffices in the
end."""

import pytest
import torch

from ghgs_lit.extents import bucket_size
from ghgs_lit.ops.intersections import TILE, intersections
from ghgs_lit.rendering import RasterSettings, gsplat_backend, reference
from ghgs_lit.rendering.capacity import defer_checks, repeat_until_sufficient
from tests.helpers.gsplat import InParts, functions
from tests.helpers.kernels import DEVICE as KERNELS
from tests.helpers.kernels import kernels
from tests.helpers.pretend_device import DEVICE, pretend_device
from tests.helpers.splats import camera_ring, cloud


def splats(images, count, height, width, seed=0):
    """Boxes that overlap tiles, lie outside the image or are empty; a fifth of them has one depth."""
    generator = torch.Generator().manual_seed(seed)
    centers = torch.rand(images, count, 2, generator=generator) * torch.tensor([1.3 * width, 1.3 * height])
    radii = (torch.rand(images, count, 2, generator=generator) * 24 - 2).clamp(min=0).ceil().int()
    depths = 1 + torch.rand(images, count, generator=generator)
    depths[:, ::5] = 1.5
    # gsplat leaves values of culled splats uninitialised
    centers[:, ::7] = float("nan")
    radii[:, ::7] = 0
    return centers - 10, radii, depths


@pytest.mark.parametrize("size", [(3, 200, 60, 75), (1, 9, 16, 16), (2, 90, 100, 33), (40, 3, 400, 400)])
def test_splats_and_offsets_are_those_of_gsplat(size):
    """The order is gsplat's: by image, tile, depth, index; 40 images have more tiles than 16 bits can
    count."""
    images, _, height, width = size
    rows, columns = -(-height // TILE), -(-width // TILE)
    centers, radii, depths = splats(*size)
    drawn = centers.nan_to_num()
    _, keys, wanted = functions()._isect_tiles(drawn, radii, depths, TILE, columns, rows, sort=False)
    keys, order = keys.sort(stable=True)  # like a radix sort
    offsets = functions()._isect_offset_encode(keys, images, columns, rows)
    found = intersections(centers, radii, depths, height, width, len(keys) + 37)
    assert int(found.needed) == len(keys) > 0
    assert torch.equal(found.splats[: len(keys)], wanted[order])
    assert torch.equal(found.offsets[:, :-1], offsets)
    assert torch.equal(
        found.offsets[:, -1],
        torch.cat((offsets[1:, 0, 0], offsets.new_tensor([len(keys)])))[:, None].expand(-1, columns),
    )
    assert (found.splats >= 0).all()
    assert (found.splats < radii[..., 0].numel()).all()
    assert found.has_pixels[:, :-1].all()
    assert not found.has_pixels[:, -1].any()


@pytest.mark.parametrize("size", [(3, 200, 60, 75), (1, 1, 16, 16), (2, 90, 100, 33), (40, 3, 400, 400)])
@pytest.mark.parametrize("capacity", [1, 300, 5000])
def test_lists_of_kernels_are_equal(size, capacity):
    """With capacity for some intersections, for all, and for more."""
    values = splats(*size)
    wanted = intersections(*values, *size[2:], capacity)
    with kernels() as called:
        found = intersections(*(value.to(KERNELS) for value in values), *size[2:], capacity)
    assert called == ["boxed", "placed"]
    for one, other in zip(found, wanted, strict=True):
        assert torch.equal(one.cpu(), other)
        assert one.dtype == other.dtype


def test_nothing_is_asked_of_the_device():
    """A second call, with cached constants, causes no device-to-host synchronisation."""
    values = splats(2, 50, 40, 40)
    with pretend_device() as log:
        values = [value.to(DEVICE) for value in values]
        for _ in range(2):
            log.clear()
            intersections(*values, 40, 40, 500)
        assert log.waits.total() == 0


@pytest.fixture
def capacities(monkeypatch):
    """Capacities that were tried, with gsplat's projection in PyTorch."""
    tried = []

    def noted(*arguments):
        tried.append(arguments[-1])
        return intersections(*arguments)

    monkeypatch.setattr(gsplat_backend, "intersections", noted)
    monkeypatch.setattr(gsplat_backend, "load", lambda: InParts)
    return tried


def drawn(size=0.3):
    gaussians, views = cloud(60, splits=(35, 25), size=size), camera_ring(2, 70, 90, batch=2)
    found = gsplat_backend.rasterize(gaussians, views, RasterSettings(), 0.5)
    return found, reference.rasterize(gaussians, views, RasterSettings(), 0.5)


def test_an_image_is_drawn_again_where_splats_lacked_room(capacities):
    """The image equals the reference's; the next one has enough capacity at once, and capacities shrink
    slowly."""
    found, wanted = repeat_until_sufficient(drawn)
    torch.testing.assert_close(found.image, wanted.image, rtol=1e-3, atol=1e-4)
    assert len(capacities) == 2
    assert capacities[0] == bucket_size(5 * 2 * 2 * 35) < capacities[1]
    repeat_until_sufficient(drawn)
    assert capacities[2:] == capacities[1:2]
    for _ in range(2):
        repeat_until_sufficient(lambda: drawn(size=0.01))
    assert len(capacities) == 5
    assert capacities[0] < capacities[4] < capacities[3]


def test_several_renderings_are_settled_together(capacities):
    """One synchronisation for all renderings; only calls that lacked capacity are repeated."""
    calls = []

    def call():
        calls.append(None)
        return drawn(), drawn()

    for found, wanted in repeat_until_sufficient(call):
        torch.testing.assert_close(found.image, wanted.image, rtol=1e-3, atol=1e-4)
    assert len(calls) == 2
    repeat_until_sufficient(call)
    assert len(calls) == 3


def test_too_little_capacity_is_detected_on_replay(capacities):
    """On replay with other values, the needed numbers are updated in place."""
    with defer_checks() as rooms:
        drawn(size=0.01)
    assert rooms.suffice()
    rooms.rooms[0].needed.fill_(rooms.rooms[0].capacity + 1)
    assert not rooms.suffice()
    with defer_checks() as rooms:
        pass
    assert rooms.suffice()
