"""Compile the Triton kernels on a machine without a GPU, for the calls of a prediction and a step.

    python benchmarks/gpu_compile.py          # for the compute capabilities 8.0, 8.6, 8.9 and 9.0
    python benchmarks/gpu_compile.py 90

Prints registers per thread and spilled bytes for each kernel and each GPU.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch.library import _scoped_library

sys.path.insert(0, str(Path(__file__).parents[1]))
os.environ.pop("TRITON_INTERPRET", None)  # read when Triton is imported

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from benchmarks import device
from ghgs_lit.config import run_of
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.geometry.precision import round_products
from ghgs_lit.method.model import GHGS
from ghgs_lit.ops import dispatch
from ghgs_lit.ops.intersections import intersections

SMALL = ("encoder.width=32", "encoder.heads=2", "encoder.vit.channels=8", "recalibration.k=8")
#: Names of types in Triton.
TYPES = {
    torch.float32: "*fp32",
    torch.int64: "*i64",
    torch.int32: "*i32",
    torch.int16: "*i16",
    torch.bool: "*i1",
    torch.uint8: "*u8",
}


class Compiler:
    """Compiles kernels instead of launching them, once for each GPU and each set of flags."""

    def __init__(self, capabilities: list[int]):
        self.capabilities = capabilities
        self.done: set[Any] = set()

    def run(
        self, kernel: Any, *arguments: Any, grid: Any, warmup: bool, num_warps: int = 4, **flags: Any
    ) -> None:
        names = [name for name in kernel.arg_names if name not in flags]
        signature = {name: _type(value) for name, value in zip(names, arguments, strict=True)}
        signature |= dict.fromkeys(flags, "constexpr")
        known = {
            name: value
            for name, value in zip(names, arguments, strict=True)
            if signature[name] == "constexpr"
        }
        for capability in self.capabilities:
            key = (kernel.__name__, capability, *signature.values(), *flags.values())
            if key not in self.done:
                self.done.add(key)
                source = ASTSource(fn=kernel, signature=signature, constexprs={**flags, **known})
                compiled = triton.compile(source, GPUTarget("cuda", capability, 32), {"num_warps": num_warps})
                switches = [name.lower() for name, value in flags.items() if value is True]
                title = " ".join((kernel.__name__.removesuffix("_rows"), *switches))
                print(f"{title}: {capability}, {_count_registers(compiled)}", flush=True)


def _type(value: Any) -> str:
    """Triton's name of the type of an argument; None and 1 are compile-time constants."""
    if isinstance(value, torch.Tensor):
        return TYPES[value.dtype]
    if value is None or (type(value) is int and value == 1):
        return "constexpr"
    return {float: "fp32", int: "i32"}[type(value)]


def _count_registers(compiled: Any) -> str:
    """Registers per thread, and spilled bytes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "kernel.ptx"
        path.write_text(compiled.asm["ptx"])
        target = re.search(r"^\.target (\w+)", compiled.asm["ptx"], re.MULTILINE)[1]
        command = [triton.knobs.nvidia.ptxas.path, "-v", f"-arch={target}", "-o", f"{path}.o", str(path)]
        text = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    registers, spilled = re.search(r"Used (\d+) registers", text)[1], re.search(r"(\d+) bytes spill", text)
    return f"{registers} registers, {spilled[1] if spilled else 0} bytes spilled"


def call_both(operator: dispatch.Operator) -> Callable[..., Any]:
    """An operator in plain PyTorch that also calls its kernel."""

    def call(*inputs):
        operator.kernels["cuda"](*inputs)
        return operator.plain(*inputs)

    return call


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("capabilities", nargs="*", type=int, default=[80, 86, 89, 90])
    compiler = Compiler(parser.parse_args().capabilities)
    batch = ellipsoid_batch(0.15, 3, 28, 1)
    with ExitStack() as stack:
        library = stack.enter_context(_scoped_library("ghgs_lit", "IMPL"))
        for name, operator in dispatch.OPERATORS.items():
            if "cuda" in operator.kernels:
                library.impl(name, call_both(operator), "CPU", allow_override=True)
        stack.enter_context(mock.patch.object(dispatch, "DEVICES", {"cpu"}))
        stack.enter_context(
            mock.patch.object(triton.JITFunction, "run", lambda *a, **b: compiler.run(*a, **b))
        )
        stack.enter_context(device.render_nothing())
        round_products(True, "cpu")  # as on a GPU
        for overrides in (("model=recurrent",), ("model=hull", "skip=fast")):
            model = GHGS.from_config(run_of("train", [*SMALL, *overrides]).plain)
            with torch.no_grad():
                model.eval()(batch)
            prediction = model.train()(batch).gaussians
            sum(getattr(prediction, name).sum() for name in ("means", "scales", "colors")).backward()
        boxes = torch.rand(1, 9, 2)
        for height, width in ((60, 75), (16, 75), (60, 16)):  # a count of one tile is a compile-time constant
            intersections(boxes, boxes.ceil().int(), boxes[..., 0], height, width, 100)


if __name__ == "__main__":
    main()
