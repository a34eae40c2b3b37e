#!/usr/bin/env bash
# Builds the wheel of pycostate, installs it in an environment of its own and runs its tests:
#
#     tests/python.sh [arguments of pytest]
#
# COSTATE_TEST_PYTHON names a Python with tests/requirements.txt, which has maturin; tests/run.sh makes one.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python="${COSTATE_TEST_PYTHON:-$PWD/target/test-venv/bin/python}"
wheels="$PWD/target/wheels"
rm -rf "$wheels"
"$python" -m maturin build --release --locked --quiet --out "$wheels"
wheel=("$wheels"/pycostate-*.whl)
if ((${#wheel[@]} != 1)); then
    echo "tests/python.sh: one wheel was to be built, not ${#wheel[@]}" >&2
    exit 1
fi
size="$(stat --format=%s "${wheel[0]}")"
if ((size > 30000000)); then
    echo "tests/python.sh: the wheel has $size bytes, more than 30 MB" >&2
    exit 1
fi

# Of its own, so that what the wheel does not ask for is not there; the tests' own needs come after it.
environment="$PWD/target/test-pycostate"
rm -rf "$environment"
"$python" -m venv "$environment"
install=("$environment/bin/python" -m pip install --quiet --disable-pip-version-check)
"${install[@]}" --constraint tests/requirements.txt "${wheel[0]}"
# A newcomer's first line, with nothing else installed.
(cd / && "$environment/bin/python" -c 'import pycostate; print(pycostate.__version__)')
"${install[@]}" --constraint tests/requirements.txt "${wheel[0]}[pictures]" pytest h5netcdf fmpy==0.3.32 casadi==3.8.2 pdoc==16.0.0 \
    "dask[distributed]==2026.8.0; python_version >= '3.11'" "dask[distributed]; python_version < '3.11'"
MPLBACKEND=Agg "$environment/bin/python" -m pytest -q -p no:cacheprovider tests/python "$@"
