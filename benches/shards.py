"""What it costs to divide work: start-up, merge, efficiency, on one machine.

    python benches/shards.py [states] [folder]

with a Python in which pycostate and Dask are installed. Everything runs on the CPU in f64; processes of one turn
run at the same time, each with one thread.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

TWO = """
states = { x = {}, v = {} }
controls = { u = { min = -2, max = 2 } }
dynamics = { x = "v", v = "-x + x^3/6 + u" }
cost = { running = "0.5*(x^2 + v^2 + u^2)" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = [-1, 1], v = [-1, 1] }
"""
ROOT = Path(__file__).resolve().parent.parent


def costate(*words, threads=None):
    environment = dict(os.environ, **({"RAYON_NUM_THREADS": str(threads)} if threads else {}))
    return subprocess.Popen([sys.executable, "-m", "pycostate", *map(str, words)], env=environment)


def timed(work):
    begun = time.perf_counter()
    work()
    return time.perf_counter() - begun


def waited(*processes):
    for process in processes:
        if process.wait():
            sys.exit(f"status {process.returncode}: {process.args}")


def measured(name, scene, points, count, folder, workers=(1, 2, 4), shards=16):
    """Shards done by so many processes at once, each taking the next when it is done with one."""

    def command(k, of, out):
        return ["solve", scene, "--points", points, "--out", out, "--backend", "cpu", "--quiet", "--shard", f"{k}/{of}"]

    # More shards than blocks of states: the last ones are empty.
    empty = [timed(lambda: waited(costate(*command(99_990 + k, 100_000, folder / "e.h5")))) for k in range(5)]
    print(f"{name}: {count} states; a shard without any {statistics.median(empty):.2f} s", flush=True)
    whole = folder / "whole.h5"
    words = ["solve", scene, "--points", points, "--out", whole, "--backend", "cpu", "--quiet"]
    alone = timed(lambda: waited(costate(*words, threads=1)))
    print(f"{name}: one run on one thread {alone:.1f} s", flush=True)
    for of in workers:
        parts = [folder / f"p{k}.h5" for k in range(shards)]
        waiting = list(range(shards))

        def work():
            going = []
            while waiting or going:
                while waiting and len(going) < of:
                    k = waiting.pop(0)
                    going.append(costate(*command(k, shards, parts[k]), threads=1))
                ended = [p for p in going if p.poll() is not None]
                waited(*ended)
                going = [p for p in going if p not in ended]
                time.sleep(0.005)

        seconds = timed(work)
        merging = timed(lambda: waited(costate("merge", *parts, "--out", folder / "all.h5", "--quiet")))
        cores = min(of, os.cpu_count())
        print(
            f"{name}: {shards} shards by {of} processes {seconds:.1f} s ({alone / seconds / cores:.0%} of one thread's, a core), merge {merging:.2f} s",
            flush=True,
        )
    sizes = [sum(p.stat().st_size for p in parts), whole.stat().st_size]
    print(f"{name}: parts {sizes[0] / count:.0f} bytes a state, the whole {sizes[1] / count:.0f}", flush=True)


def main(states=100_000, folder=None):
    folder = Path(folder or tempfile.mkdtemp(prefix="bench-"))
    random = np.random.default_rng(1)

    def points(name, names, lo, hi, count):
        path = folder / name
        np.savetxt(path, random.uniform(lo, hi, (count, len(lo))), delimiter=",", header=names, comments="", fmt="%.17g")
        return path

    scene = folder / "two.toml"
    scene.write_text(TWO)
    of_two = points("two.csv", "x,v", [-1, -1], [1, 1], states)
    measured("two states", scene, of_two, states, folder)
    few = max(states // 20, 100)
    of_five = points("five.csv", "z,vx,vz,phi,omega", [-0.9, -1, -1, -0.5, -1], [0.9, 1, 1, 0.5, 1], few)
    measured("five states", ROOT / "scenarios" / "quadrotor.toml", of_five, few, folder)


if __name__ == "__main__":
    main(*(int(a) if k == 0 else a for k, a in enumerate(sys.argv[1:])))
