#!/usr/bin/env bash
# The demo: built-in people, the four ablations after a short training, one table.
# Run it with `make demo`. GHGS_DEMO_DIR is the directory that it writes to; arguments are further overrides.
set -euo pipefail
cd "$(dirname "$0")/.."
out="${GHGS_DEMO_DIR:-runs/demo_$(date +%Y-%m-%d_%H-%M-%S)}"

ghgs train -m experiment=demo ablation=full,no_unprojection,no_semantic,neither "hydra.sweep.dir=$out" "$@"
ghgs table runs="$out" illustration=true "hydra.run.dir=$out/table"

full="$(dirname "$(dirname "$(grep -lx -e '- ablation=full' "$out"/*/.hydra/overrides.yaml | head -n 1)")")"

cat <<TEXT

Table:        $out/table/table.md
Pictures:     $out/*/pictures
Splat:        ghgs predict checkpoint=$full/checkpoints/last.ckpt
TensorBoard:  tensorboard --logdir $out
(the commands are in .venv/bin: source .venv/bin/activate)
TEXT
