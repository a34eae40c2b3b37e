#!/usr/bin/env bash
# The shooting-out work of benches/README.md by costate (once for each set of instructions it compiles
# for) and by the tools that users would take instead, in turns on this machine, as one table of
# medians: error against speed.
#
#     benches/peers.sh [RUNS] [TRAJECTORIES]        (5 and 16384)
#
# Python packages go into target/peers; what was measured is in target/peers/shoot_out.jsonl. On a
# GPU: benches/peers/shoot_out.cu, diffrax_gpu.py.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
runs=${1:-5}
count=${2:-16384}
here=${CARGO_TARGET_DIR:-target}/peers
mkdir -p "$here"
if [ ! -x "$here/bin/python" ]; then
    python3 -m venv "$here"
    "$here/bin/pip" install --quiet heyoka numba diffrax "jax[cpu]" scipy numpy
fi
cargo bench --no-run --bench shoot_out
lines=$here/shoot_out.jsonl
: >"$lines"
for run in $(seq "$runs"); do
    echo "run $run of $runs" >&2
    # The slow ones once: their figures are far from the others'.
    peers=heyoka
    if [ "$run" = 1 ]; then peers="heyoka numba diffrax"; fi
    # shellcheck disable=SC2086 # several words
    "$here/bin/python" benches/peers/shoot_out.py "$count" $peers >>"$lines"
    cargo bench --quiet --bench shoot_out -- "$count" sets few >>"$lines"
done
"$here/bin/python" benches/peers/table.py "$lines" 1e-3 1e-6 1e-9 1e-11
