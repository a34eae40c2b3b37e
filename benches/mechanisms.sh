#!/usr/bin/env bash
# Planar chains of N links: x' and p' by costate and forward dynamics and their derivatives by pinocchio,
# in turns on one core of this machine, as one table.
#
#     benches/mechanisms.sh [N ...]        (2 3 5 7 10 15 20 25 30)
#
# Pinocchio comes from the Python index (pin, cmeel-eigen), into target/peers, and is called from C++
# (g++ -O3 -march=native): its Python calls take longer than what they compute.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
sizes=("$@")
if [ ${#sizes[@]} = 0 ]; then sizes=(2 3 5 7 10 15 20 25 30); fi
here=${CARGO_TARGET_DIR:-target}/peers
mkdir -p "$here"
if [ ! -x "$here/bin/python" ]; then python3 -m venv "$here"; fi
"$here/bin/pip" install --quiet pin cmeel-eigen
prefix=$("$here/bin/python" -c 'import sysconfig; print(sysconfig.get_paths()["purelib"])')/cmeel.prefix
g++ -O3 -march=native -std=c++17 -DNDEBUG -DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS -DBOOST_MPL_LIMIT_LIST_SIZE=30 \
    -I"$prefix/include" -I"$prefix/include/eigen3" benches/peers/mechanisms.cpp \
    -L"$prefix/lib" -lpinocchio_default -Wl,-rpath,"$prefix/lib" -o "$here/mechanisms"
cargo bench --no-run --bench mechanisms
lines=$here/mechanisms.jsonl
: >"$lines"
for n in "${sizes[@]}"; do
    "$here/mechanisms" "$n" >>"$lines"
    cargo bench --quiet --bench mechanisms -- "$n" >>"$lines"
done
"$here/bin/python" benches/peers/mechanisms_table.py "$lines"
