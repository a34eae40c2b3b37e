"""Every scene by the command and by Python: the same bits? As a table in Markdown.

    python tests/python/all_scenes.py [SCENE...]

It takes as long as all scenes do, twice; the tests do a few of them.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pycostate

ROOT = Path(__file__).resolve().parents[2]
COMMAND = Path(sys.executable).with_name("costate")
#: What differs from run to run.
CLOCKS = {"seconds", "fit_seconds", "rate", "wall_seconds"}


def compared(want, made):
    """Variables, and those that differ."""
    all_, differ = 0, []
    if set(want.children) != set(made.children):
        differ.append("groups")
    for name in want.children:
        a, b = want[name].to_dataset(), made[name].to_dataset()
        for variable in set(a.variables) | set(b.variables):
            if variable in CLOCKS:
                continue
            all_ += 1
            there = variable in a.variables and variable in b.variables
            if not there or not same(a[variable].values, b[variable].values):
                differ.append(f"{name}/{variable}")
    return all_, differ


def same(a, b):
    return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


def check(path, problem):
    begun = time.perf_counter()
    done = subprocess.run([COMMAND, "check", path, "--json"], capture_output=True, check=True)
    command = time.perf_counter() - begun
    begun = time.perf_counter()
    made = problem.check().summary
    python = time.perf_counter() - begun
    want = json.loads(done.stdout)
    differ = [k for k in want.keys() | made.keys() if want.get(k) != made.get(k)]
    return f"{command:.2f} | {python:.2f} | {len(want)} | {', '.join(differ) or 'none'}"


def main(scenes):
    print("| scene | part | command s | Python s | variables | that differ |")
    print("| --- | --- | --- | --- | --- | --- |")
    worst = 0
    for path in scenes:
        problem = pycostate.Problem.load(path)
        # A scene that is only simulated has nothing else to do.
        part, method = ("simulate", problem.simulate) if "[simulation]" in problem.text else ("run", problem.run)
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder, "a.h5")
            options = ["--no-report"] if part == "run" else []
            begun = time.perf_counter()
            done = subprocess.run(
                [COMMAND, part, path, "--backend", "cpu", "--out", out, "--quiet", *options],
                capture_output=True,
                text=True,
            )
            command = time.perf_counter() - begun
            if done.returncode == 2:
                # Nothing to run: what follows from it.
                print(f"| {path.stem} | check | {check(path, problem)} |", flush=True)
                continue
            begun = time.perf_counter()
            made = method(backend="cpu", out=Path(folder, "b.h5"))
            python = time.perf_counter() - begun
            count, differ = compared(pycostate.open(out), made)
        worst = max(worst, len(differ))
        print(f"| {path.stem} | {part} | {command:.2f} | {python:.2f} | {count} | {', '.join(differ) or 'none'} |", flush=True)
    return 1 if worst else 0


if __name__ == "__main__":
    import warnings

    warnings.simplefilter("ignore", pycostate.CostateWarning)
    names = sys.argv[1:] or [
        p.stem
        for p in sorted((ROOT / "scenarios").glob("*.toml"))
        if "[dynamics]" in p.read_text() or "[mechanism]" in p.read_text()
    ]
    sys.exit(main([ROOT / "scenarios" / f"{name}.toml" for name in names]))
