"""Check annotated shapes, speed up composing, and limit the threads of each test process."""

import gc
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

# Without bytecode files, as in many containers, each process started by a test compiles PyTorch and
# Lightning anew, which takes longer than most tests.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

from tests.helpers.shapes import begin_test, check_shapes  # noqa: E402

# Garbage collection would take a tenth of the suite's time. It runs only between some tests, even where a
# verb re-enables it; modules and tests are excluded.
gc.set_threshold(0)
_TESTS_BETWEEN = 64

# Test processes and their children share the cores; more threads than cores slow each other down,
# most of all if they spin while waiting.
_THREADS = max(1, (os.cpu_count() or 2) // int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")))
os.environ |= {"OMP_NUM_THREADS": str(_THREADS), "OMP_WAIT_POLICY": "PASSIVE"}

_PACKAGE = Path(__file__).parents[1] / "ghgs_lit"
_CHECKED = ["extents", "types", "losses", "metrics"]
# Without their kernel folders: a wrapped function cannot be compiled.
for name in (
    "method.bounds",
    "method.encoder",
    "geometry",
    "method.heads",
    "pretext",
    "method.recalibration",
):
    _CHECKED += [f"{name}.{path.stem}" for path in (_PACKAGE / name.replace(".", "/")).glob("*.py")]
check_shapes([f"ghgs_lit.{name}" for name in _CHECKED])

import torch  # noqa: E402
from hydra.core.hydra_config import HydraConfig  # noqa: E402

# Without a GPU, Triton kernels run on CPU tensors; Triton reads this variable on import.
if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"

import tests.helpers.composing  # noqa: E402, F401
from ghgs_lit.config.registry import load_plugins  # noqa: E402
from ghgs_lit.geometry.precision import _Rounding  # noqa: E402

load_plugins()  # before any test replaces the registry

torch.set_num_threads(_THREADS)

# Shells start background jobs with Ctrl-C ignored, and child processes inherit that.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)


#: Environment variables that a verb and Lightning set for the rest of their process.
_LEFT = ("HYDRA_FULL_ERROR", "PL_GLOBAL_SEED", "PL_SEED_WORKERS")


_VARIABLES = {name: os.environ.get(name) for name in _LEFT}
_ROUNDING = {device: _Rounding.now(device) for device in ("cpu", "cuda")}


def _as_at_first() -> None:
    for name, value in _VARIABLES.items():
        os.environ.pop(name, None)
        if value is not None:
            os.environ[name] = value
    for device, rounding in _ROUNDING.items():
        rounding.restore(device)
    HydraConfig.instance().cfg = None  # marks a job as part of a sweep


@pytest.fixture(autouse=True)
def nothing_is_left_to_the_next_test() -> Iterator[None]:
    """Undo changes that a verb makes to its process: variables, precision of products, and log handlers,
    whose streams and files belong to one test.

    Also undone before a test, because a module-scoped fixture may have called a verb.
    """
    _as_at_first()
    root = logging.getLogger()
    handlers = list(root.handlers)
    yield
    _as_at_first()
    root.setLevel(logging.WARNING)
    for handler in [one for one in root.handlers if one not in handlers]:
        if type(handler) in (logging.StreamHandler, logging.FileHandler):
            root.removeHandler(handler)
            handler.close()


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """Tensors of tests are small: more threads would only wait for one another."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def pytest_collection_finish() -> None:
    gc.freeze()


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("gpu") and not torch.cuda.is_available():
        pytest.skip("needs a GPU")
    if begin_test() % _TESTS_BETWEEN == 0:
        gc.collect()
