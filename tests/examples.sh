#!/usr/bin/env bash
# Runs the readers in examples/ on result files, each where its interpreter is found:
#
#     tests/examples.sh [--install]
#
# --install (and CI=true) installs Octave on Debian and Ubuntu and, where Julia is found, HDF5.jl. What did not run is
# said with its reason; exits 1 where a reader fails on a good file or accepts a wrong one, and in CI without the Python.
# COSTATE names a built program, COSTATE_TEST_PYTHON a Python with tests/requirements.txt; tests/run.sh sets the latter.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

install=false
[[ "${CI:-}" == true || "${1:-}" == --install ]] && install=true
python="${COSTATE_TEST_PYTHON:-$PWD/target/test-venv/bin/python}"
export MPLBACKEND=Agg

work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT

if [[ -z "${COSTATE:-}" ]]; then
    cargo build --release --quiet --locked --bin costate
    COSTATE="${CARGO_TARGET_DIR:-target}/release/costate"
fi
# Four states with different numbers of nodes, one with a single node, and two controls: axes taken for one another
# show. In the pendulum's file they differ in nothing but their values, and there are sheets.
cat scenarios/linear_quadratic.toml - >"$work/masses.toml" <<'END'

[homotopy]
x1 = [-0.6, 0.7, 5]
v1 = 0.3
x2 = [-0.5, 0.8, 4]

[map]
resolution = { x1 = 7, v1 = 5, x2 = 6 }
END
cp scenarios/pendulum.toml "$work"
for scene in pendulum masses; do
    "$COSTATE" run "$work/$scene.toml" --backend cpu --out "$work/$scene.h5" >"$work/$scene.log" 2>&1 || {
        cat "$work/$scene.log" >&2
        exit 1
    }
done

installed_apt() {
    local run=()
    command -v apt-get >/dev/null || return 1
    if [[ "$(id -u)" -ne 0 ]]; then
        command -v sudo >/dev/null || return 1
        run=(sudo)
    fi
    "${run[@]}" apt-get update -qq &&
        "${run[@]}" env DEBIAN_FRONTEND=noninteractive \
            apt-get install -y -qq --no-install-recommends "$@" >"$work/apt.log" 2>&1
}

octave_there() { octave-cli --norc --eval 'pkg load netcdf' >/dev/null 2>&1; }

# Each of these says on standard output why its reader cannot run, or nothing.
missing_python() {
    "$python" -c 'import xarray, h5py, scipy, matplotlib' 2>/dev/null || echo "no $python with tests/requirements.txt"
}
missing_octave() {
    octave_there && return
    if ! $install; then
        echo "no octave-cli with the package netcdf; --install gets them"
    elif ! installed_apt octave octave-netcdf || ! octave_there; then
        echo "octave and octave-netcdf could not be installed"
    fi
}
missing_matlab() { command -v matlab >/dev/null || echo "no matlab"; }
missing_julia() {
    command -v julia >/dev/null || { echo "no julia"; return; }
    export JULIA_PROJECT="$PWD/target/test-julia"
    mkdir -p "$JULIA_PROJECT"
    julia -e 'using HDF5' >/dev/null 2>&1 && return
    if ! $install; then
        echo "julia has no HDF5.jl; --install gets it"
    elif ! timeout 600 julia -e 'import Pkg; Pkg.add("HDF5")' >"$work/julia.log" 2>&1; then
        echo "HDF5.jl could not be installed"
    fi
}

read_python() { rm -f "$work/picture.png" && "$python" examples/read_result.py "$1" "$work/picture.png" && [[ -s "$work/picture.png" ]]; }
read_octave() {
    octave-cli --norc --path examples --eval "read_result('$1')" || return
    # The tables at the nodes are V and u of the file; the block's syntax, for coder.* is MATLAB's alone.
    octave-cli --norc --path examples --eval "
        tables = lookup_tables('$1');
        first = cellfun(@(a) a(1), tables.axes, 'UniformOutput', false);
        varied = find(cellfun(@numel, tables.axes) > 1);
        at = interpn(tables.axes{varied}, squeeze(tables.V), first{varied});
        assert(at, tables.V(1), 1e-12);
        assert(all(isfinite(tables.V(:))) && all(isfinite(tables.u{end}(:))));
        assert(any(tables.known(:)) && numel(tables.V) == prod(cellfun(@numel, tables.axes)));
        __parse_file__('examples/law_block.m');"
}
read_matlab() { matlab -batch "addpath examples; read_result('$1')"; }
read_julia() { JULIA_PROJECT="$PWD/target/test-julia" julia examples/read_result.jl "$1"; }

# A wrong file: V of the map transposed, which no shape gives away. A reader that takes it has checked nothing.
if "$python" -c 'import h5py' 2>/dev/null; then
    cp "$work/pendulum.h5" "$work/wrong.h5"
    "$python" -c 'import h5py, sys
with h5py.File(sys.argv[1], "r+") as file:
    file["map/V"][...] = file["map/V"][...].T.copy()' "$work/wrong.h5"
else
    echo "examples: no h5py to make a wrong file with: not tried whether readers refuse one"
fi

passed=0 failed=0 skipped=0
for reader in python octave matlab julia; do
    reason="$("missing_$reader")"
    if [[ -n "$reason" ]]; then
        if $install && [[ $reader == python ]]; then
            echo "examples: $reader failed: $reason"
            failed=$((failed + 1))
        else
            echo "examples: $reader skipped: $reason"
            skipped=$((skipped + 1))
        fi
        continue
    fi
    verdict=passed
    for scene in pendulum masses; do
        if "read_$reader" "$work/$scene.h5" >"$work/log" 2>&1; then
            head -n 1 "$work/log"
        else
            verdict="failed on $scene"
            cat "$work/log"
        fi
    done
    if [[ -f "$work/wrong.h5" ]] && "read_$reader" "$work/wrong.h5" >/dev/null 2>&1; then
        verdict="failed: took a transposed map for a right one"
    fi
    echo "examples: $reader $verdict"
    if [[ $verdict == passed ]]; then passed=$((passed + 1)); else failed=$((failed + 1)); fi
done
echo "examples: $passed passed, $failed failed, $skipped skipped"
((failed == 0))
