#!/usr/bin/env bash
# Train on a real SLURM: a sweep by hydra/launcher=slurm, one whose jobs run out of time, and an sbatch job that is
# queued again; the last weights must be those of undisturbed runs, bit for bit.
#
#     bash scripts/slurm_drill.sh runs/slurm_drill [overrides of ghgs train]
#
# Needs the extra `cluster` and SLURM's programs (Debian: apt-get install slurm-wlm munge). It starts a SLURM of one
# node with its own configuration and key in the new directory, beside any that is there, and stops it at the end.
# STEPS (default 160) must take longer than the 1 to 2 minutes after which a job's time is up.
set -euo pipefail
out=$(realpath -m "${1:?expected a new directory}")
shift
[ ! -e "$out" ] || { echo "$out: expected a new directory; found one" >&2; exit 1; }
for program in slurmctld slurmd munged sbatch srun scontrol; do
    PATH=$PATH:/usr/sbin command -v $program > /dev/null ||
        { echo "$program: expected SLURM's programs (apt-get install slurm-wlm munge); found none" >&2; exit 1; }
done
PATH=$PATH:/usr/sbin
steps=${STEPS:-160}
mkdir -p "$out"/{munge,state,spool,log}
chmod 711 "$out" "$out/munge"
cd "$(dirname "$0")/.."

# The cluster: requeued jobs start after cred_expire seconds (SLURM's default: 120).
dd if=/dev/urandom of="$out/munge/key" bs=128 count=1 status=none
chmod 400 "$out/munge/key"
cat > "$out/slurm.conf" <<TEXT
ClusterName=drill
SlurmctldHost=localhost
SlurmctldPort=26817
SlurmdPort=26818
AuthType=auth/munge
AuthInfo=socket=$out/munge/socket,cred_expire=10
SlurmUser=$(id -un)
SlurmdUser=$(id -un)
StateSaveLocation=$out/state
SlurmdSpoolDir=$out/spool
SlurmctldPidFile=$out/slurmctld.pid
SlurmdPidFile=$out/slurmd.pid
SlurmctldLogFile=$out/log/slurmctld.log
SlurmdLogFile=$out/log/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
ReturnToService=2
JobRequeue=1
MpiDefault=none
NodeName=localhost CPUs=$(getconf _NPROCESSORS_ONLN) RealMemory=4000 State=UNKNOWN
PartitionName=drill Nodes=localhost Default=YES MaxTime=INFINITE State=UP
TEXT
export SLURM_CONF=$out/slurm.conf
stop() {
    scancel --user="$(id -un)" 2> /dev/null || true
    for file in "$out"/slurmctld.pid "$out"/slurmd.pid "$out"/munge/pid; do
        [ ! -s "$file" ] || kill "$(cat "$file")" || true
    done
}
trap stop EXIT
munged --force --key-file="$out/munge/key" --socket="$out/munge/socket" --pid-file="$out/munge/pid" \
    --log-file="$out/munge/log" --seed-file="$out/munge/seed"
slurmctld
slurmd -N localhost
for _ in $(seq 60); do
    [ "$(sinfo --noheader --format=%T 2> /dev/null || true)" != idle ] || break
    sleep 1
done
echo "SLURM $(sinfo --version | cut -d' ' -f2), $(getconf _NPROCESSORS_ONLN) cores: $(sinfo --noheader --format='%P %T')"

# Nothing is saved or validated before the end, unless a signal asks for it.
train=(python -m ghgs_lit.cli.main train experiment=demo 'data.people={train: 4, val: 1}' data.size=56
    'evaluation.views=[4]' evaluation.pictures=0 data.workers=0 "data.cache_dir=$out/data" callbacks=steps
    callbacks.last.every_n_train_steps=1000000 callbacks.last.minutes=null
    "trainer.max_steps=$steps" trainer.max_time=null "trainer.val_check_interval=$steps" "$@")
slurm=(hydra/launcher=slurm hydra.launcher.partition=drill hydra.launcher.gpus_per_node=null
    hydra.launcher.cpus_per_task=1 hydra.launcher.mem_gb=1)
begun=$SECONDS
step() { echo "[$((SECONDS - begun)) s] $*"; }

step "undisturbed: seeds 1 and 2, without SLURM"
"${train[@]}" -m seed=1,2 hydra/launcher=joblib hydra.launcher.n_jobs=2 "hydra.sweep.dir=$out/whole" > "$out/log/whole" 2>&1

step "refused by sbatch: a partition and a gres that there are not"
for wrong in hydra.launcher.partition=nope +hydra.launcher.gres=unicorn:1; do
    "${train[@]}" -m seed=1,2 "${slurm[@]}" "$wrong" "hydra.sweep.dir=$out/refused" > "$out/log/refused" 2>&1 &&
        { echo "$wrong: expected exit code 1; found 0" >&2; exit 1; }
    grep -c . "$out/log/refused" | sed "s/^/lines: /"
    tail -n 1 "$out/log/refused"
done

step "sweep by hydra/launcher=slurm"
"${train[@]}" -m seed=1,2 "${slurm[@]}" "hydra.sweep.dir=$out/sweep" > "$out/log/sweep" 2>&1
tail -n 2 "$out/log/sweep"

step "the same with 3 minutes for a job, and a signal 60 s before"
"${train[@]}" -m seed=1,2 "${slurm[@]}" hydra.launcher.timeout_min=3 hydra.launcher.signal_delay_s=60 \
    "hydra.sweep.dir=$out/timed" > "$out/log/timed" 2>&1
tail -n 2 "$out/log/timed"

step "sbatch and srun; scontrol requeue after 20 s of training"
job=$(sbatch --parsable --output="$out/log/requeued" --open-mode=append --ntasks=1 --wrap \
    "srun $(printf '%q ' "${train[@]}" seed=1 "hydra.run.dir=$out/requeued")")
while ! grep -qs '"started"' "$out/requeued/run.json"; do sleep 1; done
sleep 20
scontrol requeue "$job"
while squeue --noheader --job="$job" 2> /dev/null | grep -q .; do sleep 1; done

step "comparison with the undisturbed runs"
python - "$out" <<'TEXT'
import json
import sys
from pathlib import Path

import torch

out = Path(sys.argv[1])
differing = whole_runs = 0
for name in ("sweep", "timed", "requeued"):
    for path in sorted(out.glob(f"{name}/**/metrics.json")):
        run = path.parent
        whole = next(out.glob(f"whole/{json.loads(path.read_text())['provenance']['config_hash']}"))
        a, b = (torch.load(r / "checkpoints/last.ckpt", weights_only=True)["state_dict"] for r in (run, whole))
        differing += (count := sum(not torch.equal(a[key], b[key]) for key in a | b))
        sessions = json.loads((run / "run.json").read_text())["sessions"]
        steps = [session["steps"] for session in sessions if "steps" in session]
        resumed = [session["resumed"] for session in sessions]
        whole_runs += name != "sweep" and len(steps) < 2
        print(f"{name}/{run.name}: steps {steps}, resumed {resumed}; {count} of {len(a)} tensors differ")
runs = len(list(out.glob("*/**/metrics.json")))
print(f"{runs} of 7 runs done, {differing} tensors differ; {whole_runs} were not interrupted (more STEPS)")
sys.exit(runs != 7 or differing != 0 or whole_runs != 0)
TEXT
