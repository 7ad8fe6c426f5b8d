"""Import, load and export at full size with random weights: time, peak memory, equality of every tensor.

    python benchmarks/weights.py [--tiny] [--folder DIR]

Every step runs in its own process, whose peak resident memory (including mapped pages of files) is compared
with the size of the model. Needs 13 GB of disk and 5 GB of memory; much less with ``--tiny``.
"""

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch
from omegaconf import OmegaConf

from ghgs_lit.cli.import_ import empty_state
from ghgs_lit.config import compose
from ghgs_lit.model import GHGS, STAGES
from ghgs_lit.weights import names
from ghgs_lit.weights.checkpoint import model_state, read_checkpoint
from ghgs_lit.weights.exporting import export_weights, write_tensors
from ghgs_lit.weights.importing import import_weights
from ghgs_lit.weights.reading import open_file

TINY = ["encoder.width=64", "encoder.depth=4", "encoder.layers=[0,1,2,3]", "encoder.vit.depth=2"]

#: Shapes that represent the parts of VGGT-1B other than the aggregator.
OTHERS = {"camera_head.x": (2048, 9), "point_head.x": (256, 2048), "track_head.x": (384, 384)}


def config(tiny: bool) -> dict:
    composed = compose("import", ["out=x", *(TINY if tiny else ())])
    return OmegaConf.to_container(composed, resolve=True)


def make(folder: Path, tiny: bool) -> None:
    """Write random weights under the published names, one file at a time."""
    own = GHGS.from_config(config(tiny), empty=STAGES).state_dict()
    torch.manual_seed(0)
    for file, table, entry in (
        ("vggt.safetensors", names.VGGT, None),
        ("release.pth", names.RELEASE, names.RELEASE_ENTRY),
    ):
        shapes = {names.to_published(name, table): tensor.shape for name, tensor in own.items()}
        shapes.pop(None)
        shapes |= OTHERS if entry is None else {}
        tensors = {name: torch.randn(shape).mul_(0.02) for name, shape in shapes.items()}
        write_tensors(folder / file, tensors, entry)


def import_(folder: Path, tiny: bool, dtype: str = "float32") -> None:
    files = str(folder / "vggt.safetensors"), str(folder / "release.pth")
    settings = config(tiny)
    state = empty_state(settings, files[1])
    print("\n".join(import_weights(state, settings, folder / f"{dtype}.ckpt", *files, dtype)))


def load(folder: Path, dtype: torch.dtype | None = None) -> None:
    """Load the model and read every weight, as a forward pass would."""
    model = GHGS.from_checkpoint(folder / "float32.ckpt", dtype=dtype)
    assert all(parameter.isfinite().all() for parameter in model.parameters())


def compare(folder: Path) -> None:
    """Check that exported files equal the imported ones bit by bit."""
    count = 0
    for name, entry in (("vggt.safetensors", None), ("release.pth", names.RELEASE_ENTRY)):
        before, after = (open_file(folder / part / name) for part in (".", "back"))
        before, after = (content[entry] if entry else content for content in (before, after))
        expected = {key for key in before if key not in OTHERS}
        assert set(after) == expected, name
        for key in expected:
            assert torch.equal(before[key], after[key]), key
        count += len(expected)
    print(f"{count} tensors are equal")


STEPS = {
    "import": import_,
    "import in bfloat16": lambda folder, tiny: import_(folder, tiny, "bfloat16"),
    "load": lambda folder, tiny: load(folder),
    "load in bfloat16": lambda folder, tiny: load(folder, torch.bfloat16),
    "export": lambda folder, tiny: export_weights(
        folder / "float32.ckpt", folder / "back" / "vggt.safetensors", folder / "back" / "release.pth"
    ),
    "compare": lambda folder, tiny: compare(folder),
}


def run_step(name: str, folder: Path, tiny: bool) -> None:
    started = time.perf_counter()
    STEPS[name](folder, tiny)
    seconds = time.perf_counter() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    half = "bfloat16" in name
    state = model_state(read_checkpoint(folder / "float32.ckpt"))
    size = sum(
        t.numel() * (2 if half and key.startswith("encoder.") else t.element_size())
        for key, t in state.items()
    )
    print(json.dumps({"step": name, "seconds": seconds, "peak": peak, "model": size}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--tiny", action="store_true", help="a small model, to try the script")
    parser.add_argument("--folder", type=Path, help="for the files (removed at the end); default: temporary")
    parser.add_argument("--step", choices=["make", *STEPS], help=argparse.SUPPRESS)
    options = parser.parse_args()
    folder = options.folder or Path(tempfile.mkdtemp())
    if options.step == "make":
        return make(folder, options.tiny)
    if options.step:
        return run_step(options.step, folder, options.tiny)
    folder.mkdir(parents=True, exist_ok=True)
    print(f"{'step':<20}{'seconds':>9}{'peak GB':>9}{'model GB':>10}{'ratio':>7}")
    try:
        for step in ("make", *STEPS):
            command = [sys.executable, __file__, "--folder", str(folder), "--step", step]
            command += ["--tiny"] * options.tiny
            lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
            if step != "make":
                row = json.loads(lines[-1])
                peak, size = row["peak"] / 1e9, row["model"] / 1e9
                print(f"{step:<20}{row['seconds']:>9.1f}{peak:>9.2f}{size:>10.2f}{peak / size:>7.2f}")
                print(
                    "\n".join(f"    {line}" for line in lines[:-1]), end="\n" * (len(lines) > 1), flush=True
                )
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
