#!/usr/bin/env bash
# The code for aarch64 on another machine, under emulation (Debian or Ubuntu, with rustup):
#
#     tests/aarch64.sh [COSTATE]
#
# Runs the unit tests of compiled code, and, given a program for this machine, compares bit by bit
# what both say of a few scenes. Takes some ten minutes, most of it building. What is emulated says
# nothing of speed.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

target=aarch64-unknown-linux-gnu
for tool in aarch64-linux-gnu-gcc qemu-aarch64; do
    command -v "$tool" >/dev/null || {
        echo "tests/aarch64.sh: no $tool here: apt-get install gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user" >&2
        exit 2
    }
done
rustup target add "$target"
emulator="qemu-aarch64 -L /usr/aarch64-linux-gnu"
export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc
export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER="$emulator"

cargo test --release --target "$target" --package costate --no-default-features --features hdf5 --lib jit
if (($#)); then
    cargo build --release --target "$target" --package costate-cli --no-default-features --features hdf5,report
    wrapper="$(mktemp)"
    trap 'rm -f "$wrapper"' EXIT
    printf '#!/bin/sh\nexec %s %s/%s/release/costate "$@"\n' \
        "$emulator" "$(realpath "${CARGO_TARGET_DIR:-target}")" "$target" >"$wrapper"
    chmod +x "$wrapper"
    "${COSTATE_TEST_PYTHON:-target/test-venv/bin/python}" tests/same_values.py "$1" "$wrapper" \
        scenarios/linear_quadratic.toml scenarios/manufactured.toml scenarios/pendulum.toml
fi
