#!/usr/bin/env bash
# Installs what the tests need on Debian or Ubuntu beside Rust, then runs them:
#
#     tests/run.sh [arguments of `cargo test`]
#
# A second run finds everything in place. Elsewhere, install a Vulkan driver, Python 3 with venv,
# ncdump and h5dump by hand; the script then says what it could not check, and goes on.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

# A software Vulkan device, so that the GPU code is tested on machines without a GPU; the
# command-line readers of the result file; Python for its other readers.
packages=(libvulkan1 mesa-vulkan-drivers hdf5-tools netcdf-bin)
if ! python3 -c 'import ensurepip, venv' 2>/dev/null; then
    packages+=(python3 python3-venv)
fi

installed() {
    [[ "$(dpkg-query --show --showformat='${Status}' "$1" 2>/dev/null)" == "install ok installed" ]]
}

as_root() {
    if [[ "$(id -u)" -eq 0 ]]; then
        "$@"
    elif command -v sudo >/dev/null; then
        sudo "$@"
    else
        echo "tests/run.sh: not root and no sudo: cannot run: $*" >&2
        return 1
    fi
}

missing=()
if command -v dpkg-query >/dev/null && command -v apt-get >/dev/null; then
    for package in "${packages[@]}"; do
        installed "$package" || missing+=("$package")
    done
else
    echo "tests/run.sh: no apt-get here; needed: ${packages[*]}" >&2
fi
if ((${#missing[@]})); then
    as_root apt-get update -qq
    as_root env DEBIAN_FRONTEND=noninteractive \
        apt-get install -y -qq --no-install-recommends "${missing[@]}"
fi

environment="$PWD/target/test-venv"
# The copy of the requirements is made last: it says that the environment is complete.
if ! cmp -s tests/requirements.txt "$environment/requirements.txt" ||
    ! "$environment/bin/python" -c '' 2>/dev/null; then
    rm -rf "$environment"
    mkdir -p target
    python3 -m venv "$environment"
    "$environment/bin/python" -m pip install --quiet --disable-pip-version-check \
        --requirement tests/requirements.txt
    cp tests/requirements.txt "$environment/requirements.txt"
fi
export COSTATE_TEST_PYTHON="$environment/bin/python"

# Vulkan drivers ask for a runtime directory; one of our own works without a login session.
XDG_RUNTIME_DIR="$(mktemp -d)"
export XDG_RUNTIME_DIR
trap 'rm -rf "$XDG_RUNTIME_DIR"' EXIT

cargo test --release --workspace "$@"

# Readers of the result file in other languages; a filtered run of the tests leaves them out.
if [[ "$*" == "" || "$*" == --locked ]]; then
    COSTATE="${CARGO_TARGET_DIR:-target}/release/costate" tests/examples.sh
    # The Python package, as a wheel.
    tests/python.sh
fi
