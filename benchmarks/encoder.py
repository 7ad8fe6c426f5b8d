"""Time, peak memory and FLOPs of a forward pass by stage: ``python benchmarks/encoder.py [--size vggt_1b]``.

Random weights, an ellipsoid in front of a ring of cameras, ``skip=none``: every token and every pixel. With
``skip=fast`` the numbers are those of the kept tokens; ``--zoom`` changes the subject's size.
Rates are compared with those of matrix products, measured before and after in the same run. With
``--literal`` the recalibration is compared with a literal version (gathers, each layer by itself).
"""

import argparse
import json
import math
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import torch
from omegaconf import OmegaConf
from torch.utils.flop_counter import FlopCounterMode

sys.path.insert(0, str(Path(__file__).parents[1]))
from recorder import Recorder, Stage, forget_peak, memory_gb, merged

from ghgs_lit.config import compose
from ghgs_lit.diagnostics.benchmark.scene import random_model
from ghgs_lit.method.model import GHGS, STAGES
from ghgs_lit.method.plan import Plan
from ghgs_lit.method.plan.patches import KeptPatches
from ghgs_lit.ops.attention import attend
from ghgs_lit.ops.linear import linear
from ghgs_lit.types import Batch, DepthBounds, Points, Tokens
from tests.helpers.literal_recalibration import literal_recalibration
from tests.helpers.scenes import make_batch

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}


def configuration(size: str, options: list[str]) -> dict:
    """The paper's model with an encoder of ``size``, without skipping any token or pixel."""
    overrides = [f"encoder={size}", "model=paper", "skip=none", "recalibration.tokens=all", *options]
    config = compose("train", overrides)
    return OmegaConf.to_container(OmegaConf.masked_copy(config, [*STAGES, "skip"]), resolve=True)


def _patch_tokens_first(model: GHGS, record: Recorder) -> Callable:
    """The encoder, recorded as two stages: patch tokens (DINOv2), then alternating attention."""
    aggregator = model.encoder.aggregator
    embed = aggregator.patch_embed

    def encode(batch: Batch, bounds: DepthBounds | None, plan: Plan) -> Tokens:
        found = []
        kept = embed.forward

        def timed(images, patches):
            with record("patch tokens (ViT)"):
                found.append(kept(images, patches))
            forget_peak()
            return found[0]

        embed.forward = timed
        try:
            start = time.perf_counter()
            tokens = model.encoder(batch.images, batch.masks, bounds, plan)
            seconds = time.perf_counter() - start
        finally:
            del embed.forward
        inner = record.stages[-1]
        peak = memory_gb("VmHWM") - record.base
        record.stages.append(Stage("aggregator", seconds - inner.seconds, inner.before_gb, peak))
        return tokens

    return encode


@torch.no_grad()
def forward(model: GHGS, batch: Batch, record: Recorder) -> tuple[Tokens, Points]:
    """``GHGS.forward``, stage by stage; returns the tokens and points that enter the
    recalibration."""
    bounds = model.bounds(batch)
    plan = model.plan(batch)
    tokens = _patch_tokens_first(model, record)(batch, bounds, plan)
    with record("depth head"):
        depth_maps = model.depth_head(tokens, batch, bounds, plan)
    with record("unproject"):
        points = model.unprojection(depth_maps, tokens, batch)
    with record("recalibration"):
        recalibrated = model.recalibration(tokens, points, plan)
    with record("Gaussian head"):
        model.gaussian_head(recalibrated, batch, points, depth_maps, plan)
    return tokens, points


def gflop_of(function: Callable) -> float:
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        function()
    return counter.get_total_flops() / 1e9


def count_gflop(config: dict, model: GHGS, batch: Batch) -> dict[str, float]:
    """GFLOP of each stage without overhead, multiplications and additions.

    The encoder's are counted on the meta device, those of the dense heads on one image.
    """
    with torch.device("meta"):
        aggregator = GHGS.from_config(config).encoder.aggregator
        kept = KeptPatches(model.encoder.keeps(batch.masks), torch.device("meta"))
    b, v, _, height, width = batch.images.shape
    channels = next(p for p in aggregator.patch_embed.parameters() if p.dim() == 4).shape[1]
    images = torch.empty(b, v, channels, height, width, device="meta")
    patch = gflop_of(lambda: aggregator.patch_embed(images.flatten(0, 1), kept))
    found = {"patch tokens (ViT)": patch, "aggregator": gflop_of(lambda: aggregator(images, kept)) - patch}
    size, c, s = model.encoder.patch_size, model.encoder.dim_latent, model.encoder.dim_semantic
    grid = (1, 1, height // size, width // size)
    one = math.prod(grid)
    index = torch.arange(one)
    place = (torch.zeros_like(index), index // grid[3], index % grid[3])
    tokens = Tokens(tuple(torch.zeros(one, c) for _ in range(4)), torch.zeros(one, s), *place, grid, size)
    head, block = model.gaussian_head, model.recalibration.block
    headers = (head.offset_header, head.scale_header, head.rot_header, head.opacity_header)
    pixel = sum(2e-9 * p.numel() for header in headers for p in header.parameters() if p.dim() == 2)
    found["depth head"] = b * v * gflop_of(lambda: model.depth_head.dpt(tokens))
    found["Gaussian head"] = b * v * (gflop_of(lambda: head.decoder(tokens)) + height * width * pixel)
    k = min(model.recalibration.k, len(kept.index) // b)
    linears = (block.q_proj, block.k_proj, block.v_proj, block.o_proj, block.mlp[0], block.mlp[2])
    each = sum(2 * linear.weight.numel() for linear in linears) + 4 * k * block.q_proj.out_features
    return found | {"recalibration": 1e-9 * len(kept.index) * (4 * each + 2 * k * s)}


def best_seconds(function: Callable, repeats: int = 3) -> float:
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


@torch.no_grad()
def product_rates(tokens: int, width: int, dtype: torch.dtype) -> dict[str, float]:
    """GFLOP/s of matrix products by ``torch.matmul`` and by ours: squares,
    and the encoder's shapes."""

    def rate(multiply: Callable, m: int, k: int, n: int) -> float:
        x, weight = torch.randn(m, k, dtype=dtype), torch.randn(n, k, dtype=dtype)
        return 2e-9 * m * k * n / best_seconds(lambda: multiply(x, weight))

    def matmul(x, weight):
        return x @ weight.T

    squares = (1024, 2048, 4096)
    shapes = [(tokens, width, part * width) for part in (1, 3, 4)] + [(tokens, 4 * width, width)]
    return {
        "torch.matmul, best square": max(rate(matmul, s, s, s) for s in squares),
        "torch.matmul, the encoder's shapes": max(rate(matmul, *shape) for shape in shapes),
        "ours, best square": max(rate(linear, s, s, s) for s in squares),
        "ours, the encoder's shapes": max(rate(linear, *shape) for shape in shapes),
    }


@torch.no_grad()
def load_kernels(dtype: torch.dtype) -> float:
    """Seconds to compile the kernels of the stages, or to read them from disk."""
    start = time.perf_counter()
    x = torch.zeros(1, 16, 1024, 64, dtype=dtype)
    if attend.has_kernel(x, x, x, None):
        torch.ops.ghgs_lit.attend(*[x[:, :1, :1]] * 3, None)
    return time.perf_counter() - start


@torch.no_grad()
def literal_stage(model: GHGS, tokens: Tokens, points: Points) -> Stage:
    """The recalibration of all layers of the first element, as the paper writes it."""
    record = Recorder()
    with record("recalibration, literal"):
        for layer in tokens.latent:
            literal_recalibration(
                model.recalibration.block, layer, points.tokens, tokens.semantic, model.recalibration.k
            )
    return record.stages[0]


def training_stages(config: dict, batch: Batch) -> list[Stage]:
    """One forward and backward pass of the encoder alone, fully trained,
    without and with checkpointing.

    Without it a whole ``vggt_1b`` takes tens of GB: choose fewer blocks with ``encoder.depth``.
    """
    stages = []
    for checkpointing in (False, True):
        options = {**config["encoder"], "trainable": "all", "checkpointing": checkpointing}
        model = random_model({**config, "encoder": options}).encoder.requires_grad_(True).train()
        for parameter in model.parameters():
            parameter.grad = torch.zeros_like(parameter)
        record = Recorder()
        with record("recomputed activations" if checkpointing else "kept activations"):
            tokens = model(batch.images, batch.masks)
            sum(layer.square().mean() for layer in tokens.latent).backward()
        stages += record.stages
    return stages


def report(stages: list[Stage], rates: dict[str, float], floor: float) -> None:
    """Print the tables in Markdown; ``floor`` is the memory with weights and photographs, in GB."""
    print("| product | GFLOP/s |\n|---|---|")
    for name, rate in rates.items():
        print(f"| {name} | {rate:.0f} |")
    yardstick, best = rates["torch.matmul, best square"], max(rates.values())
    print("\n| stage | GFLOP | s | GFLOP/s | of torch.matmul | of the best product | GB before | peak GB |")
    print("|---|---|---|---|---|---|---|---|")
    whole = [stage for stage in stages if "literal" not in stage.name]
    for stage in [*stages, merged("encoder", stages[:2]), merged("whole forward", whole)]:
        rate = stage.gflop / stage.seconds
        share = f"{rate:.0f} | {rate / yardstick:.0%} | {rate / best:.0%}" if stage.gflop else "- | - | -"
        memory = f"{stage.before_gb:.2f} | {stage.peak_gb:.2f}"
        print(f"| {stage.name} | {stage.gflop:.0f} | {stage.seconds:.2f} | {share} | {memory} |")
    print(f"\nGB are in addition to the {floor:.2f} GB of code, weights and photographs.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="vggt_1b", help="a member of the config group encoder")
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--side", type=int, default=518, help="of the square photographs, in pixels")
    parser.add_argument("--zoom", type=float, default=0.8, help="focal length in sides: the subject's size")
    parser.add_argument(
        "--dtype", choices=list(DTYPES), default="float32", help="bfloat16 runs under autocast"
    )
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--literal", action="store_true", help="time the literal recalibration, too")
    parser.add_argument("--train", action="store_true", help="measure the encoder's training instead")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("options", nargs="*", help="further overrides of the configuration")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    dtype = DTYPES[options.dtype]
    config = configuration(options.size, options.options)
    batch = make_batch(1, options.views, options.side, options.side, zoom=options.zoom)
    if options.train:
        print("| encoder, forward and backward | s | peak GB above weights and gradients |\n|---|---|---|")
        for stage in training_stages(config, batch):
            print(f"| {stage.name} | {stage.seconds:.1f} | {stage.peak_gb:.2f} |", flush=True)
        return
    loading = load_kernels(dtype)
    model = random_model(config)
    gflop = count_gflop(config, model, batch)
    width, size = model.encoder.dim_semantic, model.encoder.patch_size
    tokens = options.views * (options.side // size) ** 2
    rates = product_rates(tokens, width, dtype)
    record = Recorder()
    with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
        seen = forward(model, batch, record)
    for stage in record.stages:
        stage.gflop = gflop.get(stage.name, 0.0)
    if options.literal:
        record.stages.append(literal_stage(model, *seen))
        record.stages[-1].gflop = gflop["recalibration"]
    again = product_rates(tokens, width, dtype)
    rates = {name: max(rate, again[name]) for name, rate in rates.items()}
    capability = torch.backends.cpu.get_cpu_capability()
    parameters = sum(p.numel() for p in model.parameters())
    print(f"{options.size}, {parameters / 1e6:.0f} M parameters, {options.views} views of {options.side}²,")
    print(f"{options.dtype}, {options.threads} threads, {capability}, torch {torch.__version__}")
    kept = int(model.encoder.keeps(batch.masks).sum())
    print(f"the subject fills {batch.masks.float().mean():.1%} of the frames, {kept} patches are kept")
    print(f"first use of the compiled kernels: {loading:.1f} s\n")
    report(record.stages, rates, record.base)
    if options.json:
        facts = {"options": vars(options) | {"json": str(options.json)}, "processor": platform.processor()}
        rows = [asdict(stage) for stage in record.stages]
        facts |= {"capability": capability, "parameters": parameters, "rates": rates, "stages": rows}
        options.json.write_text(json.dumps(facts | {"weights_gb": record.base}, indent=1) + "\n")
        print(f"rows: {options.json}")


if __name__ == "__main__":
    main()
