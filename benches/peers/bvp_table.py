"""The same boundary value problems by scipy.solve_bvp and by costate, side by side.

    python benches/peers/bvp_table.py BVP.npz BVP.json COSTATE.h5 SECONDS [SECONDS ...]

SECONDS are the wall times of costate's runs, the whole program. V is compared at every state that both
solved: solve_bvp's horizon is cut and its tolerance 1e-6, so that it is no reference below that.
"""

import json
import statistics
import sys

import h5py
import numpy as np


def main():
    bvp = np.load(sys.argv[1])
    with open(sys.argv[2]) as lines:
        line = json.loads(lines.read())
    seconds = [float(s) for s in sys.argv[4:]]
    with h5py.File(sys.argv[3]) as file:
        x, value = file["points/x0"][:], file["points/V"][:]
    # Both in one order.
    mine, theirs = (np.lexsort(np.round(of, 9).T) for of in (x, bvp["x"]))
    assert np.allclose(x[mine], bvp["x"][theirs], atol=1e-9), "not the same states"
    v, w, ok = value[mine], bvp["V"][theirs], bvp["solved"][theirs]
    off = np.abs(v - w)[ok & np.isfinite(v)] / np.maximum(1e-3, w[ok & np.isfinite(v)])
    rate, own = line["states"] / line["seconds"], len(v) / statistics.median(seconds)
    print("| tool | states | solved | seconds | states/s | ratio |")
    print("| --- | --- | --- | --- | --- | --- |")
    print(f"| {line['tool']} | {line['states']} | {line['solved']} | {line['seconds']:.1f} | {rate:.1f} | 1 |")
    print(
        f"| costate (median of {len(seconds)}, the whole program) | {len(v)} | {np.isfinite(v).sum()} |"
        f" {statistics.median(seconds):.2f} | {own:.0f} | {own / rate:.0f} |"
    )
    print(f"\nV differs by at most {off.max():.1e} of itself (median {np.median(off):.1e}).")


main()
