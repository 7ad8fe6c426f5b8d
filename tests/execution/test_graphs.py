"""Captured calls: replays, rejections, and what distinguishes shape buckets."""

import copy
import dataclasses
import warnings
from contextlib import nullcontext
from functools import lru_cache
from weakref import ref

import pytest
import torch
from torch import nn

from ghgs_lit.execution import graphs
from ghgs_lit.execution.graphs import GraphCache
from ghgs_lit.geometry.precision import precision_of
from ghgs_lit.types import Batch, Cameras
from tests.helpers.capture_backends import OperatorBackend
from tests.helpers.pretend_device import DEVICE, pretend_device

HERE = "cpu"


pytestmark = pytest.mark.usefixtures("no_gradient")


def make_cache(**options):
    return GraphCache(backend=OperatorBackend(HERE), **options)


def numbers(seed, *shape):
    return torch.randn(*shape or (2, 3), generator=torch.Generator().manual_seed(seed))


def work(values):
    """Views, in-place writes to its own memory, sorting, and several results, two of which are the same."""
    a, b = values
    table = torch.zeros_like(a)
    table[:, 1:] = a[:, 1:] * 2
    table.add_(b)
    order = table.flatten().argsort()
    best = table.flatten()[order].view_as(a)
    return {"best": best, "same": best, "order": (order, 3, "name")}


def test_other_values_give_what_an_eager_call_gives():
    """From the third call on only the graph runs, and results are not overwritten."""
    cache, calls = make_cache(), []

    def count_calls(values):
        calls.append(None)
        return work(values)

    found = [cache(count_calls, (numbers(seed), numbers(seed + 50))) for seed in range(6)]
    for seed, result in enumerate(found):
        wanted = work((numbers(seed), numbers(seed + 50)))
        assert torch.equal(result["best"], wanted["best"])
        assert torch.equal(result["order"][0], wanted["order"][0])
        assert result["order"][1:] == (3, "name")
        assert result["best"] is result["same"]
    assert len(calls) == 3  # eager, warm-up before the capture, and capture
    assert cache.counts == {"eager": 1, "captured": 1, "replayed": 4}


def test_dataclasses_come_back_with_what_they_keep():
    """Attributes that are not fields are inputs like fields: captured functions may depend on them."""
    cache = make_cache()

    def move(cameras):
        extrinsics = cameras.extrinsics + vars(cameras)["noted"]
        return dataclasses.replace(cameras, extrinsics=extrinsics)

    for seed in range(4):
        cameras = Cameras(numbers(seed, 2, 3, 3), numbers(seed, 2, 4, 4), 5, 6)
        vars(cameras)["noted"] = numbers(seed + 9, 2, 4, 4)
        found = cache(move, cameras)
        assert torch.equal(found.extrinsics, cameras.extrinsics + vars(cameras)["noted"])
        assert (found.height, found.width) == (5, 6)
    assert cache.counts["replayed"] == 2


def test_what_a_call_keeps_is_computed_by_the_graph():
    """Values cached by the call before the capture belong to its inputs, and must be recomputed."""
    cache = make_cache()

    def shifted(batch):
        return batch.images + batch.once(of_images)

    def of_images(batch):
        return batch.images.sum()

    for seed in range(4):
        images = numbers(seed, 1, 1, 3, 2, 2)
        batch = Batch(
            images, images[:, :, 0] > 0, Cameras(numbers(1, 1, 1, 3, 3), numbers(1, 1, 1, 4, 4), 2, 2)
        )
        assert torch.equal(cache(shifted, batch), images + images.sum())
    assert cache.counts["replayed"] == 2


def bfloat16():
    return torch.autocast("cpu", torch.bfloat16)


def other_bucket(name):
    """Inputs, key and state of PyTorch that differ from the usual ones in one respect."""
    usual = {"inputs": (numbers(0), numbers(1), 7), "key": ("skip", 1), "around": nullcontext()}
    changes = {
        "shape": {"inputs": (numbers(0, 2, 4), numbers(1, 2, 4), 7)},
        "dtype": {"inputs": (numbers(0).double(), numbers(1), 7)},
        "number": {"inputs": (numbers(0), numbers(1), 8)},
        "type": {"inputs": (numbers(0), numbers(1), 7.0)},
        "structure": {"inputs": [numbers(0), numbers(1), 7]},
        "key": {"key": ("skip", 2)},
        "autocast": {"around": bfloat16()},
        "gradient": {"around": torch.enable_grad()},
        "inference": {"around": torch.inference_mode()},
        "rounding": {"around": precision_of("tf32", torch.device("cuda"))},
    }
    return usual | changes.get(name, {})


NAMES = ["shape", "dtype", "number", "type", "structure", "key", "autocast", "gradient", "inference"]


@pytest.mark.parametrize("name", NAMES)
def test_each_difference_is_another_bucket(name):
    """Everything that a graph fixes must be equal."""
    cache = make_cache()
    for each in ("usual", "usual", name, "usual"):
        case = other_bucket(each)
        with case["around"]:
            cache(lambda values: values[0] + values[1], case["inputs"], case["key"])
    assert cache.counts == {"eager": 2, "captured": 1, "replayed": 1}


def test_rounding_of_products_is_another_bucket():
    """TF32 selects other kernels."""
    kinds = []
    for name in ("usual", "rounding"):
        with other_bucket(name)["around"]:
            kinds.append(graphs._torch_state("cuda"))
    assert kinds[0] != kinds[1]


@lru_cache(maxsize=1)
def table(size):
    return torch.arange(float(size))


def reads(values):
    return values[0] * float(values[0].sum())


def decides(values):
    return values[0] if values[0].sum() > 0 else -values[0]


def selects(values):
    return values[0][values[0] > 0]


def counts_places(values):
    return values[0].nonzero()


def repeats(values):
    return values[0].repeat_interleave(values[1].abs().int().sum(1), 0)


REFUSED = {
    reads: "a value is read",
    decides: "a value is read",
    selects: "a size depends on values",
    counts_places: "a size depends on values",
    repeats: "a size depends on values",
}


@pytest.mark.parametrize("function", REFUSED)
def test_what_cannot_be_replayed_stays_eager(function):
    """A warning gives the reason once, and results are right."""
    cache = make_cache()
    cache(function, (numbers(0), numbers(1)))
    with pytest.warns(UserWarning, match=REFUSED[function]):
        cache(function, (numbers(0), numbers(1)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for seed in range(3):
            values = (numbers(seed), numbers(seed + 1))
            assert torch.equal(cache(function, values), function(values))
            cache(function, (*values, seed))
            cache(function, (*values, seed))
    assert cache.counts["refused"] == 4
    assert cache.counts["captured"] == 0


def refusal(function, values):
    """Reason why a function is not captured on the pretend device."""
    cache = GraphCache(backend=OperatorBackend())
    cache(function, values)
    with pytest.warns(UserWarning, match="not captured"):
        cache(function, values)
    return cache.reasons[-1]


def test_copies_from_the_host_are_refused():
    """A replay would read host memory whose content has changed; a synchronous copy fails on CUDA."""
    cache = GraphCache(backend=OperatorBackend())
    with pretend_device():
        values = numbers(0).to(DEVICE)
        cache(lambda x: x + torch.tensor([1.0, 2.0, 3.0], device=x.device), values)
        with pytest.warns(UserWarning, match=r"the host's memory is copied by aten::\w+"):
            cache(lambda x: x + torch.tensor([1.0, 2.0, 3.0], device=x.device), values)
        assert "a value is read" in refusal(lambda x: x + len(x.tolist()), values)
        for _ in range(3):
            found = cache(lambda x: x + torch.ones(3, device=x.device), values, key="made there")
        assert torch.equal(found.cpu(), numbers(0) + 1)
    assert cache.counts["replayed"] == 1


def test_the_least_recently_used_graph_makes_room():
    """An evicted graph is captured again when its bucket returns."""
    cache = make_cache(limit=2)
    for size in (1, 1, 2, 2, 1, 3, 3):  # 2 is evicted
        cache(lambda x: x + 1, numbers(0, size))
    assert cache.counts == {"eager": 3, "captured": 3, "replayed": 1}
    cache(lambda x: x + 1, numbers(0, 1))
    cache(lambda x: x + 1, numbers(0, 2))
    assert cache.counts == {"eager": 3, "captured": 4, "replayed": 2}
    assert len(cache._graphs) == 2


def test_memory_of_caches_is_kept():
    """A cache may drop a table that a graph reads."""
    cache = make_cache()
    address = table(3).data_ptr()
    for seed in range(3):
        found = cache(lambda x: x + table(3), numbers(seed))
        table(4)
        if seed == 0:
            address = table(3).data_ptr()
    assert torch.equal(found, numbers(2) + torch.arange(3.0))
    kept = [storage.data_ptr() for each in cache._graphs.values() for storage in each.kept]
    assert address in kept or table(3).data_ptr() in kept


def test_weights_that_change_in_place_are_read():
    """Training updates weights in place; if they move, everything is captured again."""
    cache, layer = make_cache(), nn.Linear(3, 2)
    for seed in range(3):
        cache(layer, numbers(seed))
    layer.weight.add_(1.0)
    assert torch.equal(cache(layer, numbers(5)), layer(numbers(5)))
    layer.weight = nn.Parameter(numbers(6, 2, 3))
    cache.clear()
    for seed in range(3):
        assert torch.equal(cache(layer, numbers(seed)), layer(numbers(seed)))
    assert cache.counts == {"eager": 2, "captured": 2, "replayed": 3}


def test_casts_of_weights_are_captured_with_what_reads_them():
    """Autocast shares casts within a context; a replay must cast the weights again."""
    cache, layer = make_cache(), nn.Linear(3, 2)
    with bfloat16():
        for seed in range(3):
            cache(layer, numbers(seed))
        layer.weight.mul_(-2.0)
        torch.clear_autocast_cache()
        assert torch.equal(cache(layer, numbers(5)), layer(numbers(5)))


def test_where_memory_is_lacking_graphs_make_room():
    """Graphs of all caches are freed; without any, or if a call has written, the error is raised."""
    holder, other = make_cache(), make_cache()
    for seed in range(2):
        holder(work, (numbers(seed), numbers(seed)))
    failures = iter([True, False, True, True])

    def large(values):
        if next(failures, False):
            raise torch.OutOfMemoryError("CUDA out of memory")
        return values + 1

    with pytest.raises(torch.OutOfMemoryError):
        make_cache()(large, numbers(0), written=[torch.ones(1)])
    assert holder._graphs
    failures = iter([True, False, True])
    with pytest.warns(UserWarning, match="too little memory"):
        assert torch.equal(other(large, numbers(0)), numbers(0) + 1)
    with pytest.raises(torch.OutOfMemoryError):  # no graph is left to free
        other(large, numbers(0), key="another")
    assert not holder._graphs
    for seed in range(3):
        holder(work, (numbers(seed), numbers(seed)))
    assert holder.counts == {"eager": 2, "captured": 2, "replayed": 1}


def test_a_capture_that_finds_too_little_memory_is_let_go_first():
    """The call that follows needs the memory that the error would keep alive. Graphs are freed, and later
    calls are captured again."""
    holder, cache, alive, calls = make_cache(), make_cache(), [], []
    for seed in range(2):
        holder(work, (numbers(seed), numbers(seed)))

    def large(values):
        calls.append(None)
        if len(calls) == 2:
            held = Held()
            alive.append(ref(held))
            raise torch.OutOfMemoryError("CUDA out of memory")
        assert all(each() is None for each in alive)
        return values + 1

    cache(large, numbers(0))
    with pytest.warns(UserWarning, match="too little memory was left beside the graphs"):
        assert torch.equal(cache(large, numbers(1)), numbers(1) + 1)
    assert not holder._graphs
    for seed in range(3):
        assert torch.equal(cache(large, numbers(seed)), numbers(seed) + 1)
    assert cache.counts == {"eager": 1, "captured": 1, "replayed": 2}


class Held:
    """Memory held by a call that fails."""


def test_what_returns_too_late_is_not_captured():
    """Graphs would evict each other before they are replayed."""
    cache = GraphCache(limit=2, backend=OperatorBackend("cpu"))
    for _ in range(3):
        for size in (1, 2, 3):
            cache(torch.neg, torch.ones(size))
    assert dict(cache.counts) == {"eager": 9}
    for _ in range(3):
        cache(torch.neg, torch.ones(3))
    assert dict(cache.counts) == {"eager": 9, "captured": 1, "replayed": 2}
    assert copy.deepcopy(cache).limit == 2
