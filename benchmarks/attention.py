"""Attention on a CPU, our kernel and PyTorch's, in the encoder's shapes: ``python benchmarks/attention.py``.

docs/encoder.md says how to limit a processor to AVX2.

Errors are root mean squares of the difference to float64, relative to that of the result, for one head.
"""

import argparse
import time
from collections.abc import Callable
from statistics import median

import torch
import torch.nn.functional as F
from torch import Tensor

from ghgs_lit.encoder import cpu

#: Sequences, heads, tokens and channels for four views of 518²: within each view, and across all views.
SHAPES = {"frame": (4, 16, 1374, 64), "global": (1, 16, 5496, 64)}


def pytorch(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    return F.scaled_dot_product_attention(q, k, v).transpose(1, 2)


def error(function: Callable, q: Tensor, k: Tensor, v: Tensor, exact: Tensor) -> float:
    """Error of ``function(q, k, v)`` relative to ``exact``, computed in float64 from unrounded inputs."""
    found = function(q, k, v)[0, :, 0].double()
    return float(((found - exact).square().mean() / exact.square().mean()).sqrt())


def seconds(functions: dict[str, Callable], repeats: int) -> dict[str, float]:
    """Median seconds of each function, called in turn after one warm-up call."""
    times = {name: [] for name in functions}
    for i in range(repeats + 1):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            if i:
                times[name].append(time.perf_counter() - start)
    return {name: median(found) for name, found in times.items()}


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print("| attention | type | ours, GFLOP/s | PyTorch | ratio | error | PyTorch |")
    print("|---|---|---|---|---|---|---|")
    for name, (n, a, t, d) in SHAPES.items():
        qkv = torch.randn(n, t, 3, a, d, generator=torch.Generator().manual_seed(0)).permute(2, 0, 3, 1, 4)
        exact = pytorch(*(x[:1, :1].double() for x in qkv))[0, :, 0]
        for dtype in (torch.float32, torch.bfloat16):
            q, k, v = (x.contiguous() for x in qkv.to(dtype))
            if not cpu.is_supported(q, v):
                print(f"| {name} | {dtype} | not used on this processor | | | | |")
                continue
            calls = {f: lambda f=f, x=(q, k, v): f(*x) for f in (cpu.attend, pytorch)}
            times = seconds(calls, options.repeats)
            rates = [4e-9 * n * a * t * t * d / times[f] for f in calls]
            one = (q[:1, :1], k[:1, :1], v[:1, :1])
            errors = [error(f, *one, exact) for f in calls]
            print(f"| {name} | {str(dtype)[6:]} | {rates[0]:.0f} | {rates[1]:.0f} ", end="")
            print(f"| {rates[0] / rates[1]:.1f} | {errors[0]:.1e} | {errors[1]:.1e} |")


if __name__ == "__main__":
    main()
