"""GPU kernels of the package, which compile without a GPU."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

import pytest
import torch
from torch import Tensor

from ghgs_lit.geometry.precision import exact
from ghgs_lit.ops import dispatch
from ghgs_lit.types import Gaussians
from tests.helpers.kernels import DEVICE, NAMES, kernels
from tests.helpers.models import ATTRIBUTES, close, make_model
from tests.helpers.scenes import make_batch

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "gpu_compile.py"
CAPABILITIES = ("80", "86", "89", "90")


def test_every_kernel_compiles_for_gpus():
    """Kernels compile to machine code of A100, RTX 30, RTX 40 and H100 without spilled registers."""
    pytest.importorskip("triton")
    env = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    command = [sys.executable, str(SCRIPT), *CAPABILITIES]
    done = subprocess.run(command, capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stdout.splitlines() if "registers" in line]
    assert all(line.endswith(" 0 bytes spilled") for line in lines)
    for capability in CAPABILITIES:
        compiled = {line.split(":")[0].split()[0] for line in lines if f": {capability}," in line}
        assert compiled == NAMES


@pytest.mark.skipif(torch.cuda.is_available(), reason="Triton works there")
def test_without_a_driver_the_reason_is_said_and_plain_pytorch_used(monkeypatch):
    """As on a machine without a C compiler, which Triton needs for its first launch."""
    pytest.importorskip("triton")
    with pytest.warns(UserWarning, match=r"Triton: expected to start kernels; found .*; plain"):
        assert not dispatch._triton_works.__wrapped__()
    monkeypatch.setitem(sys.modules, "triton.runtime", None)
    assert not dispatch._triton_works.__wrapped__()  # not installed: no warning


def test_a_switch_of_tests_and_nothing_else_chooses_kernels():
    boxes = torch.ones(1, 2, 2)
    given = torch.zeros(2, dtype=torch.long), 3, 4
    has_kernel = dispatch.OPERATORS["boxed"].has_kernel
    assert not has_kernel(boxes, boxes.int(), *given)
    with kernels():
        assert has_kernel(boxes, boxes.int(), *given)
        assert not has_kernel(boxes, boxes.double(), *given)
        assert not has_kernel(boxes, boxes.int().to("meta"), *given)


def test_a_prediction_and_its_gradients_with_kernels_are_plain_pytorchs():
    """Test all kernels together, in a model with refinement rounds, on two subjects."""
    model = make_model("model=recurrent").to(DEVICE)
    batch = make_batch(2, 3, 28, 28)

    def predict() -> tuple[Gaussians, Tensor]:
        torch.manual_seed(0)
        model.zero_grad()
        fresh = dataclasses.replace(batch).to(DEVICE)
        with torch.no_grad():
            found = model.eval()(fresh).gaussians
        learned = model.train()(fresh).gaussians
        sum(getattr(learned, name).square().sum() for name in ATTRIBUTES).backward()
        return found, torch.cat([p.grad.flatten() for p in model.parameters() if p.grad is not None])

    # Independent of settings left by other tests: TF32 would change the results.
    with exact(DEVICE.type), mock.patch.object(dispatch, "DEVICES", set()):
        expected, slopes = predict()
    with exact(DEVICE.type), kernels() as called:
        found, found_slopes = predict()
    # gsplat lists the splats, and in float32 the memory of rounds is computed by plain PyTorch.
    assert set(called) == NAMES - {"boxed", "placed", "remember"}
    close(found, expected, 1e-4)
    assert (found_slopes - slopes).norm() < 1e-3 * slopes.norm()
