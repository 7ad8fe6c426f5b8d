"""Sections of ``benchmarks/gpu.py``: functions of a :class:`Call`, whose docstrings are titles of tables."""

import gc
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.gpu_data import loader, people, training
from benchmarks.gpu_measure import Call, reason
from benchmarks.gpu_replay import judge_optimizer, judge_prediction, judge_step
from ghgs_lit.config.run import Run
from ghgs_lit.diagnostics.benchmark.measure import TOTAL, SecondsProbe, top_level, watch_block, watch_model
from ghgs_lit.diagnostics.machine import machine_facts
from ghgs_lit.execution import Predictor
from ghgs_lit.execution.graphs import GraphCache
from ghgs_lit.execution.step import CapturedStep
from ghgs_lit.geometry.precision import keep_rounded, precision_of
from ghgs_lit.method.model import GHGS
from ghgs_lit.method.rounds import NoRounds
from ghgs_lit.ops.dispatch import OPERATORS
from ghgs_lit.training.optimization import hold_rates
from ghgs_lit.types import Batch, map_tensors

PRECISIONS = ("float32", "tf32", "bfloat16")
#: PyTorch's attention backends except cuDNN's, the fastest first.
ATTENTION = (SDPBackend.FLASH_ATTENTION, SDPBackend.EFFICIENT_ATTENTION, SDPBackend.MATH)


def machine(call: Call) -> None:
    """The machine and its peak rates"""
    gpu, sizes = call.gpu, call.sizes
    facts = machine_facts(gpu.device if gpu.is_real else torch.device("cpu"))
    call.add("versions", **{name: str(value) for name, value in facts.items()})
    source = torch.rand(sizes.copied, device=gpu.device)
    target = torch.empty_like(source)
    ms = gpu.milliseconds(lambda: target.copy_(source), sizes.repeats)
    call.add("copy", ms=ms, gb_s=2 * source.nbytes / ms / 1e6)
    for name in PRECISIONS:
        dtype = torch.bfloat16 if name == "bfloat16" else torch.float32
        a, b = (torch.rand(sizes.product, sizes.product, device=gpu.device).to(dtype) for _ in range(2))
        with precision_of("tf32" if name == "tf32" else "float32", torch.device("cuda")):
            ms = gpu.milliseconds(partial(torch.mm, a, b), sizes.repeats)
        call.add(f"product, {name}", ms=ms, tflop_s=2 * sizes.product**3 / ms / 1e9)


def _build(call: Call, run: Run) -> GHGS:
    """A model with fresh weights, created on the device."""
    with call.gpu.device:
        return GHGS.from_config(run.plain).to(call.gpu.device)


def _measure_prediction(
    call: Call, name: str, predictor: Predictor, batch: Batch, precisions: Sequence[str] = PRECISIONS
) -> None:
    """Add rows of a prediction in each precision."""
    for precision in precisions:
        predictor.precision = precision
        with torch.no_grad():
            run = partial(predictor, batch)
            ms = call.gpu.milliseconds(run, call.sizes.repeats)
            work = call.gpu.work(run)
            stages = {}
            if predictor.options.capture == "off":  # a probe prevents the capture of stages
                probe = SecondsProbe(call.gpu.device)
                with watch_model(predictor.model, probe), watch_block(TOTAL, probe):
                    run()
                seconds = probe.seconds()
                stages = {f"{stage}_ms": 1e3 * seconds[stage] for stage in top_level(seconds)}
            call.add(f"{name}, {precision}", ms=ms, **work, **stages)


def prediction(call: Call) -> None:
    """A prediction of the shipped weights, eager and replayed"""
    predictor = _enable_capture(call, Predictor.from_checkpoint(map_location=call.gpu.device))
    for size in call.sizes.batches:
        batch = replace(call.batch(size, call.sizes.side), targets=None).to(call.gpu.device)
        for capture in ("off", "auto"):
            predictor.options = predictor.options.replace(capture=capture)
            _measure_prediction(
                call, f"{call.sizes.side}², batch of {size}, capture={capture}", predictor, batch
            )
        for predictor.precision in PRECISIONS:
            judge_prediction(call, f"batch of {size}, {predictor.precision}", predictor, batch)
        cache = predictor.graphs
        call.add(f"batch of {size}, graphs", reason="; ".join(cache.reasons), **cache.counts)


def _enable_capture(call: Call, predictor: Predictor) -> Predictor:
    """The predictor with a graph cache for this device."""
    predictor.graphs = GraphCache(backend=call.gpu.backend())
    return predictor


def paper(call: Call) -> None:
    """A prediction of a large encoder, model=paper"""
    model = _build(call, call.run(f"encoder={call.sizes.encoder}", "model=paper")).eval()
    predictor = Predictor(model)
    predictor.options = predictor.options.replace(capture="off")
    batch = replace(call.batch(1, call.sizes.large), targets=None).to(call.gpu.device)
    name = f"{call.sizes.encoder}, {call.sizes.large}²"
    _measure_prediction(call, name, predictor, batch)
    if call.gpu.is_real:  # a rehearsal has no autocast
        keep_rounded(model.encoder, torch.bfloat16)
    _measure_prediction(call, f"{name}, rounded weights", predictor, batch, ("bfloat16",))
    with sdpa_kernel([SDPBackend.CUDNN_ATTENTION, *ATTENTION], set_priority=True):
        _measure_prediction(
            call, f"{name}, rounded weights, cuDNN's attention first", predictor, batch, ("bfloat16",)
        )


class _Step:
    """A training step on a batch in page-locked memory, in parts."""

    def __init__(self, call: Call, run: Run, batch: Batch, autocast: bool = False):
        self.device, self.host, self.autocast = call.gpu.device, batch, autocast
        self.model = _build(call, run).train()
        if not isinstance(self.model.rounds, NoRounds):
            self.model.rounds.options = self.model.rounds.options.replace(training_counts=(2,))
        self.renderer, self.losses = run.renderer.build(), run.loss.build()
        self.predictor = _enable_capture(call, Predictor(self.model))
        self.captured_step = CapturedStep(self.predictor, self.renderer, self.losses)
        self.captured_step.graphs = GraphCache(backend=call.gpu.backend())
        self.options = run.optimizer
        self.optimizer = self.options.optimizer(self.model)
        hold_rates(self.optimizer)
        if not call.gpu.is_real and self.options.matrix_scale is not None:  # as Muon does on CUDA
            self.optimizer.graphs = GraphCache(limit=2, backend=call.gpu.backend())

    def data(self) -> None:
        self.batch = self.host.to(self.device, non_blocking=True)

    def forward(self) -> None:
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.autocast):
            self.prediction = self.predictor(self.batch)

    def render(self) -> None:
        self.rendering = self.renderer(self.prediction.gaussians, self.batch.targets.cameras)

    def loss(self) -> None:
        self.total = self.losses(self.prediction, self.rendering, self.batch)[0]

    def backward(self) -> None:
        self.total.backward()

    def optimize(self) -> None:
        nn.utils.clip_grad_norm_(self.model.parameters(), self.options.clip, foreach=True)
        self.optimizer.step()
        self.optimizer.zero_grad()

    def compute_loss(self) -> Tensor:
        """The loss, operator by operator; all under autocast, as in training."""
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.autocast):
            for part in (self.forward, self.render, self.loss):
                part()
        return self.total

    def replay_loss(self) -> Tensor:
        """The loss, with stages, rendering and gradients replayed."""
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.autocast):
            return self.captured_step(self.batch).total

    def run_captured(self) -> None:
        """The replayed step."""
        self.data()
        self.replay_loss().backward()
        self.optimize()

    @property
    def parts(self) -> list[Callable[[], None]]:
        return [self.data, self.forward, self.render, self.loss, self.backward, self.optimize]

    def __call__(self) -> None:
        for part in self.parts:
            part()


def _measure_step(call: Call, name: str, step: _Step) -> None:
    """Add rows of a step: as a whole, and for each part."""
    torch.cuda.reset_peak_memory_stats()
    ms = call.gpu.milliseconds(step, call.sizes.repeats)
    call.add(name, ms=ms, peak_gb=torch.cuda.max_memory_allocated() / 1e9, **call.gpu.work(step, 2))
    together = call.gpu.milliseconds_of_each(step.parts, call.sizes.repeats)
    for part, ms in zip(step.parts, together, strict=True):
        call.add(f"{name}: {part.__name__}", ms=ms, **call.gpu.work(part, 1))


def _measure_captured_step(call: Call, name: str, step: _Step) -> None:
    """Add rows of a replayed step: its time, and its agreement with eager calls."""
    ms = call.gpu.milliseconds(step.run_captured, call.sizes.repeats)
    cache = step.captured_step.graphs
    work = call.gpu.work(step.run_captured, 2)
    call.add(f"{name}, captured", ms=ms, reason="; ".join(cache.reasons), **work, **cache.counts)
    judge_step(call, name, step)
    judge_optimizer(call, f"{name}, optimizer", step)


def step(call: Call) -> None:
    """A training step of experiment=shipped on a prepared batch, two rounds; parts measured separately"""
    for size in reversed(call.sizes.batches):
        made = _Step(call, call.run(*call.shipped), call.batch(size, call.sizes.side))
        with precision_of("tf32", torch.device("cuda")):  # as trainer=gpu
            _measure_step(call, f"batch of {size}", made)
            _measure_captured_step(call, f"batch of {size}", made)
        del made
        gc.collect()


def frozen(call: Call) -> None:
    """A training step of a large frozen encoder within 24 GB, model=paper, loss=paper, bf16-mixed"""
    total = torch.cuda.get_device_properties(call.gpu.device).total_memory
    torch.cuda.set_per_process_memory_fraction(min(24e9 / total, 1.0))
    encoder = [f"encoder={call.sizes.encoder}", "encoder.trainable=none", "model=paper", "loss=paper"]
    for size in call.sizes.large_batches:
        try:
            made = _Step(call, call.run(*encoder), call.batch(size, call.sizes.large), autocast=True)
            _measure_step(call, f"batch of {size}", made)
            _measure_captured_step(call, f"batch of {size}", made)
        except torch.cuda.OutOfMemoryError as error:
            call.add(f"batch of {size}", refused=reason(error))
        made = None
        gc.collect()
        torch.cuda.empty_cache()


class _Calls(TorchDispatchMode):
    """Collects the first inputs of each operator of the package."""

    def __init__(self) -> None:
        super().__init__()
        self.inputs: dict[str, tuple[Callable[..., Any], Sequence[Any]]] = {}

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        if function.namespace == "ghgs_lit":
            self.inputs.setdefault(function.name().partition("::")[2], (function, args))
        return function(*args, **(kwargs or {}))


def kernels(call: Call) -> None:
    """Triton kernels, the same eager and compiled, with memory rates; attention by backend"""
    predictor = Predictor.from_checkpoint(map_location=call.gpu.device)
    batch = replace(call.batch(max(call.sizes.batches), call.sizes.side), targets=None).to(call.gpu.device)
    predictor.precision = "tf32"
    with _Calls() as calls:
        with torch.no_grad():
            predictor(batch)  # one kernel runs only without gradients
        predictor(batch).gaussians.means.sum().backward()
    with_kernels = {name for name, operator in OPERATORS.items() if "cuda" in operator.kernels}
    for name in with_kernels - set(calls.inputs):
        call.add(name, refused="not called")
    moved = {}
    for name, (function, inputs) in calls.inputs.items():
        moved[name] = _bytes(inputs) + _bytes(function(*inputs))
        for kind, run in {"kernel": function, "eager": OPERATORS[name].plain}.items():
            _measure_operator(call, name, kind, partial(run, *inputs), moved[name])
    _measure_attention(call)
    for name, (_, inputs) in calls.inputs.items():  # the slowest part
        compiled = torch.compile(OPERATORS[name].plain, dynamic=False)
        _measure_operator(call, name, "compiled", partial(compiled, *inputs), moved[name])


@torch.no_grad()
def _measure_operator(call: Call, name: str, kind: str, run: Callable[[], Any], moved: int) -> None:
    """Add a row of an operator; its rate is by the bytes of its inputs and outputs."""
    try:
        ms, work = call.gpu.milliseconds(run, call.sizes.repeats), call.gpu.work(run)
        call.add(f"{name}, {kind}", ms=ms, gb_s=moved / max(work["busy_ms"], 1e-6) / 1e6, **work)
    except Exception as error:
        call.add(f"{name}, {kind}", refused=reason(error))


def _bytes(value: Any) -> int:
    found: list[int] = []

    def note(tensor: Tensor) -> Tensor:
        found.append(tensor.nbytes)
        return tensor

    map_tensors(value, note)
    return sum(found)


@torch.no_grad()
def _measure_attention(call: Call) -> None:
    """Add rows of the global attention of ``vggt_1b`` in bfloat16."""
    tokens = call.sizes.views * ((call.sizes.large // 14) ** 2 + 5)
    q, k, v = torch.rand(3, 1, 16, tokens, 64, device=call.gpu.device, dtype=torch.bfloat16)
    for backend in (SDPBackend.FLASH_ATTENTION, SDPBackend.CUDNN_ATTENTION, SDPBackend.EFFICIENT_ATTENTION):
        name = f"attention, {tokens} tokens, {backend.name.lower()}"
        try:
            with sdpa_kernel(backend):
                run = partial(nn.functional.scaled_dot_product_attention, q, k, v)
                ms = call.gpu.milliseconds(run, call.sizes.repeats)
            call.add(name, ms=ms, tflop_s=4 * 16 * tokens**2 * 64 / ms / 1e9)
        except RuntimeError as error:
            call.add(name, refused=reason(error))


SECTIONS: dict[str, Callable[[Call], None]] = {
    section.__name__: section
    for section in (
        *(machine, step, prediction, paper, frozen, kernels, loader),
        *(people, training),
    )
}
