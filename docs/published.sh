#!/bin/sh
# Solves the published problems of scenarios/published with the released binary and writes docs/published.md.
#   docs/published.sh [PATH/TO/costate]        (default: target/release/costate)
set -eu
here=$(cd "$(dirname "$0")" && pwd)
exec python3 "$here/published.py" "${1:-$here/../target/release/costate}"
