"""CUDA-graph capture: its streams and memory, and the state after a failure."""

from contextlib import contextmanager

import pytest
import torch

from ghgs_lit.execution import capture
from ghgs_lit.execution.capture import CudaGraphs
from ghgs_lit.execution.graphs import GraphCache


class Graphs:
    """Stand-ins for CUDA's streams and graphs, which record events.

    Args:
        log: list of events.
        end_fails: whether ending a failed capture fails as well, as when CUDA has already ended it.
    """

    def __init__(self, log, end_fails=False):
        self.log, self.end_fails = log, end_fails
        self.current = self.main = self.Stream("main")
        self.pools = 0

    class Stream:
        def __init__(self, name="side"):
            self.name = name

        def wait_stream(self, other):
            pass

    class Graph:
        def __init__(self, log):
            self.log = log

        def replay(self):
            self.log.append("play")

    def new_stream(self, device):
        self.log.append(f"stream of {device}")
        return self.Stream()

    @contextmanager
    def stream(self, stream):
        before, self.current = self.current, stream
        self.log.append("warm")
        yield
        self.current = before

    @contextmanager
    def graph(self, graph, pool, stream, capture_error_mode):
        before, self.current = self.current, stream
        self.log.append(f"record {capture_error_mode} {pool}")
        try:
            yield
        except Exception as error:
            if self.end_fails:
                raise RuntimeError("cannot end") from error
            self.current = before
            raise
        self.current = before

    def new_graph(self):
        return self.Graph(self.log)

    def new_pool(self):
        self.pools += 1
        return self.pools

    def set_stream(self, stream):
        self.current = stream

    def install(self, patch):
        capture._side_stream.cache_clear()
        members = {
            "Stream": self.new_stream,
            "current_stream": lambda device=None: self.current,
            "current_device": lambda: 0,
            "stream": self.stream,
            "set_stream": self.set_stream,
            "graph": self.graph,
            "graph_pool_handle": self.new_pool,
            "CUDAGraph": self.new_graph,
        }
        for name, value in members.items():
            patch.setattr(torch.cuda, name, value)


@pytest.fixture
def graphs(monkeypatch):
    yield lambda *given, **options: Graphs(*given, **options).install(monkeypatch)
    capture._side_stream.cache_clear()


def test_graphs_are_made_as_pytorch_documents(graphs):
    """A call on a side stream, then the capture there; all on one stream, and in one memory pool as long
    as one of its graphs exists."""
    log = []
    graphs(log)
    cuda = CudaGraphs()
    (result, play), (_, other) = (cuda.capture(lambda: log.append("call") or 5) for _ in range(2))
    play()
    assert result == 5
    once = ["warm", "call", "record thread_local 1", "call"]
    assert log == ["stream of 0", *once, *once, "play"]
    del play, other
    cuda.capture(lambda: log.append("call"))
    assert log[-2] == "record thread_local 2"


@pytest.mark.parametrize("end_fails", [True, False])
def test_a_capture_that_fails_leaves_the_device_as_it_was(monkeypatch, end_fails):
    """PyTorch's context does not restore the stream if it cannot end a capture. Casts made meanwhile were
    not computed, and written memory is restored."""
    log, calls, weight = [], [], torch.ones(3)
    stand_in = Graphs(log, end_fails)
    stand_in.install(monkeypatch)
    cache = GraphCache(backend=CudaGraphs("cpu"))
    cleared = []
    monkeypatch.setattr(torch, "clear_autocast_cache", lambda: cleared.append(len(calls)))

    def work(values):
        calls.append(stand_in.current.name)
        weight.add_(values)
        if len(calls) == 3:
            raise RuntimeError("operation not permitted when stream is capturing")
        return weight * 2

    expected = weight.clone()
    for number in range(3):
        if number == 1:
            with pytest.warns(UserWarning, match="cannot end" if end_fails else "not permitted"):
                found = cache(work, torch.ones(3), written=[weight])
        else:
            found = cache(work, torch.ones(3), written=[weight])
        expected += 1
        assert torch.equal(found, 2 * expected)
        assert stand_in.current is stand_in.main
    assert calls == ["main", "side", "side", "main", "main"]
    assert cleared == [1, 2, 3]
    assert cache.counts == {"eager": 2, "refused": 1}
    capture._side_stream.cache_clear()
