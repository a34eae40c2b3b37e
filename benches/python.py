"""The engine in Python beside the command: the same states in turn, a million values, the import.

    python benches/python.py [states] [turns]

with a Python in which pycostate is installed. Everything runs on the CPU in f64. Times are of whole
processes for the command, and of the call, its result as a Dataset included, for Python.
"""

import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

SCENE = """
states = { x = {}, v = {} }
controls = { u = { min = -2, max = 2 } }
dynamics = { x = "v", v = "-x + x^3/6 + u" }
cost = { running = "0.5*(x^2 + v^2 + u^2)" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = [-1, 1], v = [-1, 1] }
"""
CALL = """
import sys, time
import numpy as np, pycostate, xarray, h5py
p = pycostate.Problem.load(sys.argv[1])
x = np.loadtxt(sys.argv[2], delimiter=",", skiprows=1)
begun = time.perf_counter()
ds = p.solve(x, backend="cpu", out=sys.argv[3])
print(time.perf_counter() - begun)
"""


def main(states=100_000, turns=5):
    folder = Path(tempfile.mkdtemp(prefix="bench-"))
    scene, points = folder / "scene.toml", folder / "points.csv"
    scene.write_text(SCENE)
    x = np.random.default_rng(1).uniform(-1, 1, (states, 2))
    np.savetxt(points, x, delimiter=",", header="x,v", comments="", fmt="%.17g")
    taken = {"command": [], "python": []}
    for _ in range(turns):
        begun = time.perf_counter()
        words = ["solve", scene, "--points", points, "--out", folder / "c.h5", "--backend", "cpu", "--quiet"]
        subprocess.run([sys.executable, "-m", "pycostate", *words], check=True)
        taken["command"].append(time.perf_counter() - begun)
        words = [sys.executable, "-c", CALL, scene, points, folder / "p.h5"]
        said = subprocess.run(words, check=True, capture_output=True, text=True).stdout
        taken["python"].append(float(said))
        print(" ".join(f"{name} {times[-1]:.2f} s" for name, times in taken.items()), flush=True)
    for name, times in taken.items():
        print(f"{states} states, {name}: median {statistics.median(times):.2f} s, least {min(times):.2f} s")

    import pycostate

    p = pycostate.Problem.load(scene)
    v = p.value(p.map(error=1e-4, backend="cpu"))
    x = np.random.default_rng(0).uniform(-0.9, 0.9, (1_000_000, 2))
    for name, call in (("v(x)", v), ("v.p(x)", v.p), ("v.u(x)", v.u)):
        times = []
        for _ in range(5):
            begun = time.perf_counter()
            call(x)
            times.append(time.perf_counter() - begun)
        print(f"{name}: {1e-6 * len(x) / statistics.median(times):.2f} million states/s (median of 5)")
    times = []
    for _ in range(5):
        begun = time.perf_counter()
        subprocess.run([sys.executable, "-c", "import pycostate"], check=True)
        bare = time.perf_counter()
        subprocess.run([sys.executable, "-c", "import numpy"], check=True)
        times.append((bare - begun, time.perf_counter() - bare))
    both = [statistics.median(column) for column in zip(*times)]
    print(f"a process that imports pycostate {both[0]:.2f} s, numpy alone {both[1]:.2f} s")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
