"""Checks annotated shapes, composes faster, and limits the threads of each test process."""

import gc
import os
import signal
import threading
from pathlib import Path

from tests.helpers.shapes import begin_test, check_shapes

# Modules and tests are no garbage: looking through them takes half a second each time.
gc.disable()

_PACKAGE = Path(__file__).parents[1] / "ghgs_lit"
_CHECKED = ["types", "losses", "metrics"]
# Without their folders of kernels: a wrapped function cannot be compiled.
for name in ("bounds", "encoder", "geometry", "heads", "pretext", "recalibration"):
    _CHECKED += [f"{name}.{path.stem}" for path in (_PACKAGE / name).glob("*.py")]
check_shapes([f"ghgs_lit.{name}" for name in _CHECKED])

import torch  # noqa: E402
import yaml  # noqa: E402
from hydra._internal import defaults_list  # noqa: E402

# Composing configurations is a quarter of the suite, reading their files a third of that: LibYAML is faster.
yaml.SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

# Hydra makes a map for each file, a third of its time, and reads it for interpolations only.
_map = defaults_list._create_interpolation_map


def _map_where_needed(overrides, defaults, *arguments):
    return _map(overrides, defaults, *arguments) if any(d.is_interpolation() for d in defaults) else None


defaults_list._create_interpolation_map = _map_where_needed

# Test processes share the cores; more threads than cores slow each other down.
torch.set_num_threads(max(1, (os.cpu_count() or 2) // int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))))

# Shells start background jobs with Ctrl-C ignored, and child processes inherit that.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


def pytest_runtest_setup() -> None:
    begin_test()
