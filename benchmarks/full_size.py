"""Presets of skip beside a literal forward, at full size: ``python benchmarks/full_size.py``.

Random weights, ``model=paper``, one built-in person. Every round runs all variants and each begins with
another one. Seconds of the stages are medians; ``kept`` is how much faster the FLOPs would allow the total to
be, ``reached`` is which part of that the measured speed-up is.
"""

import argparse
import dataclasses
import json
import sys
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parents[1]))
from literal import write_out

from ghgs_lit.cli.inputs import build_data
from ghgs_lit.config import compose, resolve
from ghgs_lit.config.compose import read_options
from ghgs_lit.diagnostics.benchmark.measure import inspect, time_cases
from ghgs_lit.diagnostics.benchmark.presets import Case, Source, cases_of
from ghgs_lit.diagnostics.benchmark.stages import TOTAL, top_level
from ghgs_lit.diagnostics.machine import in_words, machine_facts
from ghgs_lit.types import Batch


def variants(cfg, presets: list[str], device: torch.device) -> list[Case]:
    """The presets, ``fast`` without a margin, and the literal forward of ``none``, with the same weights."""
    config = resolve(cfg)
    chosen = read_options("skip", presets, config["skip"], "presets")
    if "fast" in chosen:
        chosen["fast, margin 0"] = {**chosen["fast"], "margin": 0}
    chosen["literal"] = chosen["none"]
    shared = {name: config[name] for name in ("renderer", "precision")}
    source = Source(config, None)
    cases = cases_of(source, chosen, {}, shared, device, seed=1)
    write_out(cases[-1].model)
    return cases


def person(config, share: tuple[float, float]) -> Batch:
    """The first built-in person whose masks cover a part of the frames within ``share``."""
    data = build_data(config)
    data.prepare_data()
    found = []
    for batch in data.evaluation_loader(split="val"):
        found.append(float(batch.masks.float().mean()))
        if share[0] <= found[-1] <= share[1]:
            return batch
    said = ", ".join(f"{value:.1%}" for value in found)
    raise SystemExit(f"no person covers {share[0]:.0%} to {share[1]:.0%} of the frames; found {said}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--presets", default="none,exact,balanced,fast", help="files of conf/skip")
    parser.add_argument("--repeats", type=int, default=2, help="rounds; one more warms up at a small size")
    parser.add_argument(
        "--share", type=float, nargs=2, default=(0.15, 0.17), help="of the frame, from and to"
    )
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("options", nargs="*", help="further overrides of `ghgs benchmark`")
    options = parser.parse_args()
    fixed = ["encoder=vggt_1b", "model=paper", "data=synthetic", "data.size=518", "data.batch_size=1"]
    cfg = compose("benchmark", [*fixed, *options.options])
    device = torch.device("cpu")
    batch = person(resolve(cfg), options.share)
    cases = variants(cfg, options.presets.split(","), device)
    works = [inspect(case, batch, device)[0] for case in cases]
    times = time_cases(cases, [batch], 0, options.repeats, device)
    report(cases, works, times, batch, options)


def report(cases, works, times, batch: Batch, options) -> None:
    """Print the table in Markdown and write the rows."""
    print(in_words(machine_facts(torch.device("cpu"))))
    print(f"the subject covers {batch.masks.float().mean():.1%} of the frames; {options.repeats} rounds\n")
    names = [*top_level(times[0]), "other"]
    columns = ["total", "quartiles", "none / it", "literal / it", "FLOPs allow", "reached", "later peak, GB"]
    print("| | " + " | ".join([*names, *columns]) + " |")
    print("|---" * (len(names) + 1 + len(columns)) + "|")
    none, literal = (
        next(i for i, case in enumerate(cases) if case.preset == name) for name in ("none", "literal")
    )
    rows = []
    for case, work, seconds in zip(cases, works, times, strict=True):
        total = seconds[TOTAL]
        ratios = [times[i][TOTAL].median / total.median for i in (none, literal)]
        allowed = works[none].flops[TOTAL] / work.flops[TOTAL]
        peak = max(work.peaks[name] for name in ("depth_head", "recalibration", "gaussian_head"))
        cells = [f"{seconds[name].median:.2f}" for name in names]
        cells += [f"{total.median:.2f}", f"{total.low:.2f}-{total.high:.2f}", *(f"{r:.2f}" for r in ratios)]
        cells += [f"{allowed:.2f}", f"{ratios[0] / allowed:.0%}", f"{peak / 1e9:.2f}"]
        print(f"| {case.preset} | " + " | ".join(cells) + " |")
        stages = {name: dataclasses.asdict(value) for name, value in seconds.items()}
        rows.append({"preset": case.preset, "seconds": stages, "flops": work.flops, "peaks": work.peaks})
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")
        print(f"rows: {options.json}")


if __name__ == "__main__":
    main()
