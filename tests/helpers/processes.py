"""Running code in a fresh interpreter."""

import os
import subprocess
import sys
from pathlib import Path


def run_python(code: str, expected: int = 0, **variables: str) -> subprocess.CompletedProcess:
    """``code``, which must end with exit code ``expected``, in a process with these variables."""
    path = os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])
    environment = {**os.environ, "PYTHONPATH": path, **variables}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == expected, done.stderr
    return done
