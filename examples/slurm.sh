#!/usr/bin/env bash
# V at many states on a Slurm cluster, in 16 shards. After a time limit it goes on by itself; after a failure the same line, or one with
# some of the tasks, does what is left:
#     sbatch --array=0-15 examples/slurm.sh SCENE.toml STATES.csv 16
#SBATCH --time=01:00:00 --cpus-per-task=8 --requeue
#SBATCH --signal=B:TERM@120
set -u
shard="$SLURM_ARRAY_TASK_ID/${3:?how many shards are there?}"
out="out/$(basename "$1" .toml)"
part="$out/part-$SLURM_ARRAY_TASK_ID.h5"
mkdir -p "$out"
export RAYON_NUM_THREADS="${SLURM_CPUS_PER_TASK:-1}"
costate solve "$1" --points "$2" --shard "$shard" --out "$part" --resume &
pid=$!
# Two minutes before the limit: costate ends with what is done, and the status 75.
trap 'kill -TERM "$pid"' TERM
wait "$pid"; status=$?
if [ "$status" -gt 128 ]; then wait "$pid"; status=$?; fi
if [ "$status" -eq 75 ]; then scontrol requeue "${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID"; fi
# The last one finds all parts, and puts them together; before, some are missing.
if [ "$status" -eq 0 ] && ! said=$(costate merge "$out"/part-*.h5 --out "$out/all.h5" 2>&1); then
    case "$said" in *"shards one is missing"* | *"shards some are missing"* | *"is not finished"*) ;; *) echo "$said" >&2; status=2 ;; esac
fi
exit "$status"
