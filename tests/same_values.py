#!/usr/bin/env python3
"""Compares what two builds of the program say of scenes, bit by bit.

    tests/same_values.py OLD NEW [SCENE.toml ...]

OLD and NEW are programs. Both run each scene on the CPU (default: all in scenarios/ and below); every number in the two
result files is compared but times and machines. Exits 1 where one differs. For a change that is to leave values alone:
build the program before it, keep it, and compare. Needs numpy and h5py (tests/requirements.txt).
"""

import pathlib
import subprocess
import sys
import tempfile

import h5py
import numpy

# What no two runs have in common.
TIMES = {"rate", "fit_seconds", "simulations_per_second", "seconds", "wall_seconds", "updates_per_second"}


def result(program, scene, out):
    """The numbers of a run by name, or what it printed where it failed."""
    command = [program, "run", str(scene), "--backend", "cpu", "--quiet", "--no-report", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        return done.stderr
    numbers = {}

    def keep(name, item):
        if isinstance(item, h5py.Dataset) and item.dtype.kind in "fiu" and name.split("/")[-1] not in TIMES:
            numbers[name] = item[()]

    with h5py.File(out) as file:
        file.visititems(keep)
    return numbers


def differences(old, new):
    """Names of what differs, with the largest difference of numbers."""
    if isinstance(old, str) or isinstance(new, str):
        return [] if old == new else ["one of them failed, or says something else"]
    found = [f"{name}: in one of them only" for name in sorted(old.keys() ^ new.keys())]
    for name in sorted(old.keys() & new.keys()):
        a, b = numpy.asarray(old[name]), numpy.asarray(new[name])
        if a.shape != b.shape:
            found.append(f"{name}: {a.shape} and {b.shape}")
        elif a.tobytes() != b.tobytes():
            apart = numpy.nanmax(numpy.abs(a.astype(float) - b.astype(float)), initial=0.0)
            found.append(f"{name}: by up to {apart:.3g}")
    return found


def main():
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    old, new = sys.argv[1:3]
    scenes = [pathlib.Path(s) for s in sys.argv[3:]]
    if not scenes:
        folder = pathlib.Path(__file__).resolve().parent.parent / "scenarios"
        scenes = sorted(p for p in folder.rglob("*.toml") if "[dynamics]" in p.read_text() or "dynamics =" in p.read_text())
    wrong = 0
    with tempfile.TemporaryDirectory() as work:
        for scene in scenes:
            results = [result(p, scene, pathlib.Path(work) / f"{k}.h5") for k, p in enumerate([old, new])]
            found = differences(*results)
            wrong += bool(found)
            count = 0 if isinstance(results[0], str) else sum(a.size for a in map(numpy.asarray, results[0].values()))
            print(f"{scene}: {'the same' if not found else 'DIFFERENT'} ({count} numbers)", *found, sep="\n    ", flush=True)
    print(f"{len(scenes)} scenes, {wrong} differ")
    sys.exit(1 if wrong or not scenes else 0)


main()
