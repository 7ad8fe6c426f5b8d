#!/usr/bin/env bash
# Run the whole test suite on the oldest and the newest Python that the package promises.
# Each gets an environment of its own, .venv-<version>. One that is not installed is named and left out.
set -euo pipefail
cd "$(dirname "$0")/.."

tested=0
for version in ${PYTHONS:-3.11 3.13}; do
    python="$(command -v "python$version" || true)"
    for candidate in "$HOME/.pyenv/versions/$version".*/bin/python; do
        [ -z "$python" ] && [ -x "$candidate" ] && python="$candidate"
    done
    if [ -z "$python" ]; then
        echo "Python $version: not installed, left out"
        continue
    fi
    echo "Python $version: $python"
    make test PYTHON="$python" VENV=".venv-$version"
    tested=$((tested + 1))
done
[ "$tested" -gt 0 ]
