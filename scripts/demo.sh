#!/usr/bin/env bash
# The demo: a person from four photographs with the weights that come with the package, brought nearer to them;
# then the four ablations after a short training on built-in people, one table.
# Run it with `make demo`. GHGS_DEMO_DIR is the directory that it writes to; arguments are further overrides.
set -euo pipefail
cd "$(dirname "$0")/.."
out="${GHGS_DEMO_DIR:-runs/demo_$(date +%Y-%m-%d_%H-%M-%S)}"

ghgs predict data=synthetic 'data.people={train: 1, val: 1}' data.size=252 subject=0 targets=midway refine=15 \
    "hydra.run.dir=$out/person"

ghgs train -m experiment=demo ablation=full,no_unprojection,no_semantic,neither "hydra.sweep.dir=$out" "$@"
ghgs table runs="$out" illustration=true "hydra.run.dir=$out/table"

full="$(dirname "$(dirname "$(grep -lx -e '- ablation=full' "$out"/*/.hydra/overrides.yaml | head -n 1)")")"

cat <<TEXT

Person:       $out/person/viewer.html (in a browser), gaussians.ply, sheet.png (inputs, depth, a view half-way)
Table:        $out/table/table.md (its rows are equal but for chance, as expected after so few steps: what the
              switches do shows in longer trainings, docs/evidence/ablation.md)
Pictures:     $out/*/pictures
Splat:        ghgs predict checkpoint=$full/checkpoints/last.ckpt
TensorBoard:  tensorboard --logdir $out
(the commands are in .venv/bin: source .venv/bin/activate)
TEXT
