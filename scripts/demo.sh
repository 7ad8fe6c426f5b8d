#!/usr/bin/env bash
# The demo: built-in people, the four ablations trained for a short time, one table.
# Run it through `make demo`. GHGS_DEMO_DIR chooses where it writes.
set -euo pipefail
cd "$(dirname "$0")/.."
out="${GHGS_DEMO_DIR:-runs/demo_$(date +%Y-%m-%d_%H-%M-%S)}"

ghgs prepare experiment=demo
ghgs train -m experiment=demo ablation=full,no_unprojection,no_semantic,neither "hydra.sweep.dir=$out"
ghgs table sweep="$out" illustration=true

cat <<TEXT

Pictures:     $out/*/pictures
TensorBoard:  $(command -v tensorboard || echo tensorboard) --logdir $out
Table:        the path above, as Markdown and CSV
TEXT
