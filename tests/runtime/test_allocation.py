"""Reuse of freed memory."""

import platform

import pytest

from tests.helpers.processes import run_python

CODE = """
import resource
import torch
from ghgs_lit.runtime.allocation import keep_freed_memory
print(keep_freed_memory())
for _ in range(12):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    torch.zeros(16 << 20).add_(1)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="mallopt is glibc's")
@pytest.mark.parametrize(("limits", "asked"), [({}, "True"), ({"MALLOC_TRIM_THRESHOLD_": "131072"}, "False")])
def test_freed_memory_is_used_again_where_the_user_set_no_limits(monkeypatch, limits, asked):
    for name in ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES"):
        monkeypatch.delenv(name, raising=False)
    said, faults = run_python(CODE, **limits).stdout.split()
    assert said == asked
    # 64 MB are 16384 pages. Reused blocks settle at their addresses within some rounds.
    assert (int(faults) < 1000) == (asked == "True")
