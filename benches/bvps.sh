#!/usr/bin/env bash
# The boundary value problems of benches/README.md by costate and by scipy.solve_bvp, in turns on this
# machine: states a second, and how far the two V are apart.
#
#     benches/bvps.sh [RUNS]        (5 of costate; solve_bvp takes a minute or two, once)
#
# Python packages go into target/peers.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
runs=${1:-5}
target=${CARGO_TARGET_DIR:-target}
here=$target/peers
mkdir -p "$here"
if [ ! -x "$here/bin/python" ]; then
    python3 -m venv "$here"
fi
"$here/bin/python" -c "import scipy, h5py" 2>/dev/null || "$here/bin/pip" install --quiet scipy h5py
cargo build --release
seconds=()
once() {
    local begin=${EPOCHREALTIME/[^0-9]/}
    "$target/release/costate" homotopy scenarios/moore_greitzer.toml --backend cpu --out "$here/box.h5" >&2
    seconds+=("$((${EPOCHREALTIME/[^0-9]/} - begin))e-6")
}
# Half of the runs before solve_bvp, half after it.
for _ in $(seq $(((runs + 1) / 2))); do once; done
"$here/bin/python" benches/peers/solve_bvp.py "$here/bvp.npz" >"$here/bvp.json"
for _ in $(seq $((runs / 2))); do once; done
"$here/bin/python" benches/peers/bvp_table.py "$here/bvp.npz" "$here/bvp.json" "$here/box.h5" "${seconds[@]}"
