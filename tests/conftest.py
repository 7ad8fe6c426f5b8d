"""Checks annotated shapes, composes faster, and limits the threads of each test process."""

import gc
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

# Where Python keeps no bytecode, as in many containers, each process that a test starts compiles
# PyTorch and Lightning anew, which takes longer than most tests.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

from tests.helpers.shapes import begin_test, check_shapes  # noqa: E402

# Modules and tests are no garbage, and looking through what is left takes a tenth of the suite: it
# is done between tests, now and then, also where a verb turns the collector on again.
gc.set_threshold(0)
_TESTS_BETWEEN = 64

# Test processes and their children share the cores; more threads than cores slow each other down,
# and those that spin while they wait do so most.
_THREADS = max(1, (os.cpu_count() or 2) // int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")))
os.environ |= {"OMP_NUM_THREADS": str(_THREADS), "OMP_WAIT_POLICY": "PASSIVE"}

_PACKAGE = Path(__file__).parents[1] / "ghgs_lit"
_CHECKED = ["extents", "types", "losses", "metrics"]
# Without their folders of kernels: a wrapped function cannot be compiled.
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

# Kernels in Triton run on tensors of the CPU where there is no GPU; read when Triton is imported.
if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"

import tests.helpers.composing  # noqa: E402, F401
from ghgs_lit.config.registry import load_plugins  # noqa: E402
from ghgs_lit.geometry.precision import _Rounding  # noqa: E402

load_plugins()  # before any test has a register of its own

torch.set_num_threads(_THREADS)

# Shells start background jobs with Ctrl-C ignored, and child processes inherit that.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)


#: Variables that a verb and Lightning set for the rest of their process.
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
    HydraConfig.instance().cfg = None  # by which a job knows that it is one of a sweep


@pytest.fixture(autouse=True)
def nothing_is_left_to_the_next_test() -> Iterator[None]:
    """A verb may change its process, which ends with it: variables, the precision of products, logs
    (whose streams are those of one test, and whose files are in its folder). A fixture of a whole
    module may have called one before."""
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


def pytest_collection_finish() -> None:
    gc.freeze()


def pytest_runtest_setup(item: pytest.Item) -> None:
    if item.get_closest_marker("gpu") and not torch.cuda.is_available():
        pytest.skip("needs a GPU")
    if begin_test() % _TESTS_BETWEEN == 0:
        gc.collect()
