"""Windows: dense heads compute a part of their output with the values of the whole."""

import itertools

import pytest
import torch
import torch.nn.functional as F

from ghgs_lit.extents import bucket_size, extents
from ghgs_lit.method.heads import dense, dpt
from ghgs_lit.method.heads.dense import decode
from ghgs_lit.method.plan.window import Span, Window, subject_windows
from tests.method.heads.test_dpt import _head, _tokens


def random_spans(full, count, seed):
    generator = torch.Generator().manual_seed(seed)
    ends = torch.randint(full, (count, 2), generator=generator).sort(-1).values
    return [Span(start, last + 1, full) for start, last in ends.tolist()]


def head_of(guided, seed):
    """A head in float64, with weights that fill their receptive fields and do not fade away."""
    head = _head(seed, guide_channels=3 if guided else 0).double()
    for parameter in head.parameters():
        torch.nn.init.normal_(parameter, std=2 * parameter[0].numel() ** -0.5)
    return head


@pytest.mark.parametrize("guided", [False, True], ids=["tokens", "guide"])
@pytest.mark.parametrize("grid", [(14, 17), (21, 9)])
@torch.no_grad()
def test_a_window_has_the_values_of_the_whole(grid, guided):
    """Positions, interpolation and zero padding are those of the whole image, up to rounding."""
    patch = 6 if guided else 14
    size = (patch * grid[0], patch * grid[1])
    tokens = _tokens(1, 1, *grid, patch_size=patch, dtype=torch.float64)
    guide = (torch.rand(1, 3, *size, dtype=torch.float64),) if guided else None
    for seed in range(2):
        head = head_of(guided, seed)
        whole = head(tokens, guide)
        corners = [
            Window(Span(0, 1, size[0]), Span(size[1] - 1, size[1], size[1])),
            Window(Span(size[0] // 2, size[0] // 2 + 1, size[0]), Span(0, size[1], size[1])),
            Window.whole(size),
        ]
        drawn = zip(random_spans(size[0], 4, seed), random_spans(size[1], 4, seed + 9), strict=True)
        for window in [*corners, *(Window(*spans) for spans in drawn)]:
            expected = whole[..., *window.slices]
            difference = (head(tokens, guide, window) - expected).abs().max()
            assert difference <= 1e-11 * whole.abs().max(), window


@pytest.mark.parametrize(
    ("source", "target"), [((7, 9), (14, 18)), ((14, 18), (27, 35)), ((8, 1), (3, 5)), ((5, 6), (5, 6))]
)
def test_a_window_is_interpolated_as_the_whole(source, target):
    """Resizing a part gives that part of the resized whole, from only the cells in ``sources``."""
    for dtype in (torch.float32, torch.float64, torch.bfloat16):
        maps = torch.randn(2, 3, *source).to(dtype)
        whole = F.interpolate(maps, target, mode="bilinear", align_corners=True)
        drawn = zip(random_spans(target[0], 30, 0), random_spans(target[1], 30, 1), strict=True)
        for window in (Window(*spans) for spans in drawn):
            needed = window.sources(source)
            found = needed.resize(maps[..., *needed.slices], window)
            assert found.dtype == dtype
            limit = {torch.float64: 1e-14, torch.float32: 1e-6, torch.bfloat16: 0.02}[dtype]
            torch.testing.assert_close(found, whole[..., *window.slices], rtol=limit, atol=limit)


def test_gradients_through_a_window_are_those_through_the_whole():
    """Training on windows is the same as on whole maps."""
    tokens = _tokens(1, 2, 12, 9, dtype=torch.float64)
    window = Window(Span(30, 50, 168), Span(90, 101, 126))
    gradients = []
    for use_window in (False, True):
        head = head_of(False, 1)
        maps = head(tokens, None, window) if use_window else head(tokens)[..., *window.slices]
        maps.square().mean().backward()
        gradients.append([parameter.grad for parameter in head.parameters()])
    for found, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-12)


def test_what_was_resized_in_inference_mode_is_resized_with_a_gradient():
    """Validation fills the cache of weights that training reads."""
    source, target = (Window(Span(1, 7, n), Span(0, 5, n)) for n in (11, 13))
    maps = torch.rand(1, 2, 6, 5)
    with torch.inference_mode():
        expected = source.resize(maps, target)
    found = source.resize(maps.requires_grad_(), target)
    found.sum().backward()
    assert torch.equal(found, expected)
    assert maps.grad.isfinite().all()


def test_a_small_window_needs_little_of_the_fine_levels():
    """Unneeded parts are not computed: the finest level is a quarter of the work."""
    windows = _head().windows(Window(Span(210, 290, 518), Span(210, 290, 518)), (37, 37))
    assert windows.full == Window(Span(209, 291, 518), Span(209, 291, 518))
    rows = windows.levels[0].level.rows
    assert rows.stop - rows.start <= 80 / 518 * 148 + 20


def masks_of(*boxes, size=(70, 56)):
    masks = torch.zeros(1, len(boxes), *size, dtype=torch.bool)
    for view, box in enumerate(boxes):
        if box is not None:
            masks[0, view, box[0] : box[1], box[2] : box[3]] = True
    return masks


CASES = {
    "border": masks_of((0, 9, 40, 56), (60, 70, 0, 3), (3, 40, 3, 9)),
    "one_pixel": masks_of((33, 34, 20, 21), None, (0, 1, 0, 1)),
    "full": masks_of((0, 70, 0, 56), None, None),
    "empty": masks_of(None, None, None),
    "two_people": masks_of((5, 12, 3, 9), (30, 60, 8, 20), None) | masks_of((50, 66, 40, 52), None, None),
}


def _windows(masks):
    return subject_windows(extents(masks.flatten(0, 1)), tuple(masks.shape[2:]))


@pytest.mark.parametrize("largest", [1, 1 << 23], ids=["one_by_one", "together"])
@pytest.mark.parametrize("name", list(CASES))
@torch.no_grad()
def test_every_wanted_pixel_is_decoded_as_in_the_whole(name, largest, monkeypatch):
    """Images one by one or in one window: each wanted pixel is in a part, with the value of the whole map."""
    monkeypatch.setattr(dense, "_LARGEST", largest)
    masks, tokens = CASES[name], _tokens(1, 3, 5, 4)
    head = _head()
    whole = head(tokens)
    missing = masks.flatten(0, 1).clone()
    parts = list(decode(head, tokens, None, _windows(masks)))
    assert parts
    for part in parts:
        expected = whole[part.images, :, *part.window.slices]
        assert (part.maps - expected).abs().max() <= 1e-5 * whole.abs().max()
        missing[part.images, *part.window.slices] = False
        assert masks.any() == masks.flatten(0, 1)[part.images].flatten(1).any(1).all()
        if largest == 1:
            assert part.images.stop - part.images.start == 1
    assert not missing.any()


def test_a_gradient_of_zero_flows_where_nothing_is_wanted():
    """Without a valid pixel, parameters still get a gradient of 0."""
    head = _head()
    (part,) = decode(head, _tokens(1, 2, 3, 3), None, [None, None])
    part.maps[:0].sum().backward()
    assert all(parameter.grad is not None for parameter in head.parameters())


def test_windows_hold_the_subject_and_no_more():
    """From the first to the last row and column of each mask; None for an empty one."""
    found = _windows(CASES["two_people"])
    assert found[0] == Window(Span(5, 66, 70), Span(3, 52, 56))
    assert found[2] is None
    whole = _windows(CASES["full"])[0]
    assert whole == Window.whole((70, 56))
    assert whole.is_whole


@pytest.mark.parametrize("full", [1, 9, 40])
def test_a_widened_span_stays_within_its_map(full):
    for start, stop in itertools.combinations(range(full + 1), 2):
        span = Span(start, stop, full).widen()
        assert 0 <= span.start <= start < stop <= span.stop <= full
        assert span.stop - span.start == min(bucket_size(stop - start), full)


@pytest.mark.parametrize("guided", [False, True], ids=["tokens", "guide"])
@torch.no_grad()
def test_rows_one_after_another_are_the_rows_at_once(guided, monkeypatch):
    """Computing the largest maps in parts does not change the result."""
    patch, grid = (6, (9, 7)) if guided else (14, (4, 3))
    size = (patch * grid[0], patch * grid[1])
    tokens = _tokens(1, 2, *grid, patch_size=patch, dtype=torch.float64)
    guide = (torch.rand(2, 3, *size, dtype=torch.float64),) if guided else None
    head = head_of(guided, 5)
    for window in (Window.whole(size), Window(Span(3, 50, size[0]), Span(5, 31, size[1]))):
        expected = head(tokens, guide, window)
        monkeypatch.setattr(dpt, "_LARGEST", 1)
        monkeypatch.setattr(dpt, "_ROWS", 5)
        assert len(head._parts(expected, window)) > 8
        found = head(tokens, guide, window)
        monkeypatch.undo()
        assert found.shape == expected.shape
        assert (found - expected).abs().max() <= 1e-12 * expected.abs().max()
