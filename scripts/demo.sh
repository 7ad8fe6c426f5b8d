#!/usr/bin/env bash
# The demo: a person from four photographs with the weights that come with the package, brought nearer to them;
# then the four ablations after a short training on built-in people, one table.
# Run it with `make demo`. GHGS_DEMO_DIR is the directory that it writes to; arguments are further overrides.
set -euo pipefail
cd "$(dirname "$0")/.."
out="${GHGS_DEMO_DIR:-runs/demo_$(date +%Y-%m-%d_%H-%M-%S)}"

ghgs predict data=synthetic 'data.people={train: 1, val: 1}' data.size=252 subject=0 targets=midway refine=15 \
    "hydra.run.dir=$out/person"

# Whose attention is drawn: the token at the right elbow of the first person.
ghgs train -m experiment=demo ablation=full,no_unprojection,no_semantic,neither 'callbacks.pictures.token=[0,3,3]' \
    "hydra.sweep.dir=$out" "$@"
ghgs table runs="$out" illustration=true "hydra.run.dir=$out/table"

full="$(dirname "$(dirname "$(grep -lx -e '- ablation=full' "$out"/*/.hydra/overrides.yaml | head -n 1)")")"

cat <<TEXT

Person:       $out/person/viewer.html (in a browser), gaussians.ply, sheet.png (inputs, depth, a view half-way)
Table:        $out/table/table.md
              Its rows are equal but for chance, and cannot differ yet: a token of these small photographs is wider
              than an arm, the features were not taught parts of the body, and logits are so near to 0 that s in
              Eq. 3, which multiplies them, hardly moves attention. Longer trainings: docs/evidence/ablation.md
Attention:    $full/pictures/step_*/*_attention.png (of an elbow, by layer, with s and with s = 1)
Pictures:     $out/*/pictures
Splat:        ghgs predict checkpoint=$full/checkpoints/last.ckpt
TensorBoard:  tensorboard --logdir $out/tensorboard
(the commands are in .venv/bin: source .venv/bin/activate)
TEXT
