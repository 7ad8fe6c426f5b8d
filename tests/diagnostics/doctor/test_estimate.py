"""The doctor's estimates: beside what is measured, and in what must follow from their definition."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from ghgs_lit.config import compose, resolve
from ghgs_lit.diagnostics.doctor.estimate import BACKWARD, Scene, estimate
from ghgs_lit.diagnostics.doctor.shapes import Shapes
from tests.helpers.models import TINY

SCENE = Scene(0.15, 3, (56, 84))


def test_memory_that_is_held_counts_and_no_other():
    """Views have none of their own, freed results none; masks have values."""
    shapes = Shapes()
    x = shapes.empty(torch.zeros(1000))
    with torch.no_grad(), shapes:
        y = x * 2
        z = y[:10]
        assert shapes.live == 4000
        del y
        assert shapes.live == 4000
        del z
        assert (shapes.live, shapes.peak) == (0, 4000)
        mask = torch.arange(1000) < 7
        assert x[mask].shape == (7,)
        assert (x.isfinite().all().item(), x.isnan().any().item(), float(x.sum())) == (True, False, 1.0)


def test_estimates_are_within_a_fifth_of_what_is_measured():
    """A fresh process, since memory that the tests before have freed would count."""
    root = Path(__file__).parents[3]
    command = [sys.executable, str(root / "benchmarks" / "memory.py"), "--json", "model=hull"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(root), *sys.path])}
    # What the script would start itself again with.
    environment |= {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}
    weights = ["loss.weights.chamfer=0.1", "loss.weights.depth=0.5"]
    done = subprocess.run([*command, *weights], env=environment, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    found = [json.loads(line) for line in done.stdout.splitlines()[-2:]]
    assert [row["what"] for row in found] == ["prediction", "training"]
    for row in found:
        assert row["estimated"] == pytest.approx(row["measured"], rel=0.2)


def test_keys_that_save_memory_do():
    """Checkpointing, half precision, fewer tokens and a smaller batch each lower the peak of a step."""
    config = resolve(compose("train", [*TINY, "model=paper", "loss=depth"]))

    def peak(scene=SCENE, precision="float32", tokens="all", **encoder):
        changed = {**config, "encoder": {**config["encoder"], **encoder}}
        changed["skip"] = {**config["skip"], "tokens": tokens}
        return estimate(changed, scene, "cuda", precision, training=True).bytes

    whole = peak()
    assert peak(checkpointing=True) < whole
    assert peak(precision="bfloat16") < whole
    assert peak(tokens="subject") < whole
    assert peak(Scene(0.15, 3, (56, 84), batch=2)) > 1.4 * whole


def test_operations_are_counted_by_stage():
    """The backward pass of products takes about twice the forward pass; predictions have none."""
    config = resolve(compose("train", ["model=hull", "loss=depth"]))
    prediction = estimate(config, SCENE, "cpu", "float32")
    step = estimate(config, SCENE, "cpu", "float32", training=True)
    assert prediction.flops["encoder"] == step.flops["encoder"] > 0
    forward = step.flops["total"] - step.flops[BACKWARD]
    assert 1.5 < step.flops[BACKWARD] / forward < 2.5
    assert BACKWARD not in prediction.flops
