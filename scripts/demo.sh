#!/usr/bin/env bash
# The demo: what a minute of training shows (the paper's model beside model=hull, with 3, 4 and 5 photographs) as a
# table; then a person from four photographs with the weights that come with the package, brought nearer to them.
# Run it with `make demo`. GHGS_DEMO_DIR is the directory that it writes to; arguments are further overrides of the
# trainings.
set -euo pipefail
cd "$(dirname "$0")/.."
out="${GHGS_DEMO_DIR:-runs/demo_$(date +%Y-%m-%d_%H-%M-%S)}"

ghgs train -m experiment=demo model=paper,hull "hydra.sweep.dir=$out" "$@"
ghgs table runs="$out" layout=table2 reported=false 'columns=[psnr,psnr_box,depth_error_mm]' "hydra.run.dir=$out/table"

ghgs predict data=synthetic 'data.people={train: 1, val: 1}' data.size=252 subject=0 targets=midway refine=15 \
    "hydra.run.dir=$out/person"

hull="$(dirname "$(grep -lx -e '  model: hull' "$out"/*/config.yaml | head -n 1)")"

cat <<TEXT

Table:        $out/table/table.md
              model=hull bounds depths by the masks; within the box of model=paper they take longer than a
              minute to learn. The paper's ablation takes hours: "Sweep, and reproduce the table" in README.md
Pictures:     $out/*/pictures
TensorBoard:  tensorboard --logdir $out
Splat:        ghgs predict checkpoint=$hull/checkpoints/last.ckpt (of the model trained here)
Person:       $out/person/viewer.html (in a browser), gaussians.ply, sheet.png (inputs, depth, a view half-way)
(the commands are in .venv/bin: source .venv/bin/activate)
TEXT
