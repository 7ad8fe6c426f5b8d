"""Tasks of CPU kernels write to disjoint memory, so that results do not depend on the threads."""

import dataclasses

import pytest
import torch

from ghgs_lit.method.bounds import VisualHull
from ghgs_lit.method.rounds.observation import observe
from ghgs_lit.ops.attention import cpu as attention
from ghgs_lit.ops.attention.cpu import QUERIES
from ghgs_lit.ops.photo_consistency import photo_consistency
from ghgs_lit.ops.round_memory import update_memory
from tests.helpers.scenes import make_batch, surface_splats
from tests.method.heads.test_gaussian import make_head
from tests.ops import test_activation, test_attention, test_round_memory


@torch.no_grad()
def run_activation():
    gaussians = make_head(axes="surface").activate(*test_activation.scene(2, 4, 56, 56))
    return [getattr(gaussians, name) for name in test_activation.FIELDS]


def run_attention(heads, tokens, dtype):
    return [attention.attend_heads(*test_attention.scene(2, heads, tokens, 32, dtype))]


def run_march():
    return list(dataclasses.astuple(VisualHull()(make_batch(2, 4, 112, 112))))


def run_observation():
    batch = make_batch(2, 4, 112, 112)
    return [observe(surface_splats(batch), batch)]


def run_memory():
    layers, rows = test_round_memory.scene(5000, 4, 11, 48, 13)
    after = update_memory(layers, *rows)
    return [after, *torch.autograd.grad(after.square().sum(), list(layers.parameters()))]


def run_sweep():
    batch = make_batch(2, 4, 112, 112)
    return [photo_consistency(batch, VisualHull()(batch), 4)]


CALLS = {
    "activation": run_activation,
    "many heads": lambda: run_attention(5, 40, torch.float32),
    "one head": lambda: run_attention(1, 7 * QUERIES + 3, torch.bfloat16),
    "march": run_march,
    "memory": run_memory,
    "observation": run_observation,
    "sweep": run_sweep,
}


@pytest.mark.parametrize("name", CALLS)
def test_the_number_of_threads_changes_no_bit(name):
    threads, results = torch.get_num_threads(), []
    try:
        for count in (1, 2, 3, 7):
            torch.set_num_threads(count)
            results.append(CALLS[name]())
    finally:
        torch.set_num_threads(threads)
    for found in results[1:]:
        assert all(torch.equal(one, other) for one, other in zip(results[0], found, strict=True))
