"""Defects planted in a copy of the package, and the cases of the stress test that catch them.

    python benchmarks/planted_defects.py

Each defect is one changed line; ``ghgs stress quick=true`` runs the stage that computes it on the copy,
before and after. Exit code 1 where a defect is not caught.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Defect:
    """What is wrong, the line (file, before, after) and the stage of the stress test that computes it."""

    says: str
    file: str
    before: str
    after: str
    stage: str


DEFECTS = (
    Defect("an epsilon removed", "heads/dpt.py", "NORM_EPS = 1e-5", "NORM_EPS = 0.0", "dense head"),
    Defect(
        "a distance in float16", "recalibration/neighbors.py", "torch.cdist(points[rows], points,",
        "torch.cdist(points[rows].half().float(), points.half().float(),", "neighbours",
    ),
    Defect(
        "a dropped clamp", "heads/activations.py", "c.clamp(max=EXP_LIMIT).exp()", "c.exp()",
        "depth activation",
    ),
    Defect(
        "a mask on the result, not the argument", "geometry/vectors.py",
        "keepdim=True).masked_fill(is_zero, 1.0)", "keepdim=True)", "unit vectors",
    ),
    Defect(
        "a Jacobian without its clamp", "rendering/cpu/projection.py", "geometry.clamped(view, x, y)", "x, y",
        "compositing",
    ),
)  # fmt: skip


def failures(copy: Path, stages: list[str]) -> list[dict]:
    """The cells with failures of a quick run on the package in ``copy``."""
    out = copy / "out"
    shutil.rmtree(out, ignore_errors=True)
    command = [sys.executable, "-m", "ghgs_lit", "stress", "quick=true", "workers=0"]
    done = subprocess.run(
        [*command, f"stages=[{','.join(stages)}]", f"hydra.run.dir={out}"], cwd=copy, capture_output=True,
        text=True, env={**os.environ, "PYTHONPATH": str(copy), "NUMBA_CACHE_DIR": str(copy / "numba")},
    )  # fmt: skip
    if not (out / "stress.json").exists():
        raise SystemExit(done.stdout + done.stderr)
    return [cell for cell in json.loads((out / "stress.json").read_text())["cells"] if cell["failures"]]


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in ("ghgs_lit", "hydra_plugins", "conf"):
            shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
        before = failures(copy, [defect.stage for defect in DEFECTS])
        if before:
            raise SystemExit(f"without a defect: {len(before)} cells fail, the first is {before[0]}")
        print("| defect | changed line | caught by |\n|---|---|---|")
        missed = 0
        for defect in DEFECTS:
            path = copy / "ghgs_lit" / defect.file
            text = path.read_text()
            if text.count(defect.before) != 1:
                raise SystemExit(f"{path}: expected {defect.before!r} once")
            path.write_text(text.replace(defect.before, defect.after))
            found = failures(copy, [defect.stage])
            path.write_text(text)
            missed += not found
            families = ", ".join(dict.fromkeys(cell["family"] for cell in found))
            caught = f"{defect.stage}: {families}" if found else "NOTHING"
            print(f"| {defect.says} | `{defect.file}`: `{defect.after}` | {caught} |", flush=True)
    raise SystemExit(min(missed, 1))


if __name__ == "__main__":
    main()
