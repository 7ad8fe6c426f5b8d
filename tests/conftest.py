"""Shape checks (jaxtyping with beartype) for the modules that annotate shapes; one thread a worker."""

import os

from jaxtyping import install_import_hook

_CHECKED = ["types", "geometry", "encoder", "heads", "recalibration", "losses", "metrics"]
install_import_hook([f"ghgs_lit.{name}" for name in _CHECKED], "beartype.beartype")

import torch  # noqa: E402

# Several test processes share the cores; more threads than cores only slow one another down.
torch.set_num_threads(max(1, (os.cpu_count() or 2) // int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))))
