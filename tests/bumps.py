"""V among narrow bumps of the cost, against fast marching.

    python tests/bumps.py COSTATE SEED [--bumps 12] [--height 100] [--width 0.006] [--states 300]

makes a scene in two states with random bumps height * exp(-r^2/width) of the running cost, asks
`COSTATE solve` for V at random states on their flanks and behind them, and lists those where V is
more than 0.6 % above that of a fast-marching method on 3201 x 3201 nodes, which errs upward. It
needs numpy, scipy and scikit-fmm, and takes a minute or two; it is no part of the tests. One seed
gives one scene.

The drift f is a gradient, f = d(phi)/dx, so that W = V - phi obeys |dW/dx|^2 = |f|^2 + 2 q, with
the running cost |u|^2/2 + q: fast marching solves it.
"""

import argparse
import csv
import pathlib
import subprocess
import tempfile

import numpy as np
import skfmm
from scipy.interpolate import RegularGridInterpolator

NODES = 3201
# W is known about the equilibrium to rounding of the drift's and the cost's series.
INNER = 0.08
ALLOWED = 6e-3


def centres(rng, args):
    found = []
    while len(found) < args.bumps:
        p = rng.uniform(-1.5, 1.5, 2)
        apart = all(np.hypot(*(p - q)) > 1.2 * np.sqrt(args.width) for q in found)
        if np.hypot(*p) > 0.4 and apart:
            found.append(np.round(p, 3))
    return np.array(found)


def scene(bumps, args):
    names = "+".join(f"b{i}" for i in range(len(bumps)))
    one = 'b%d = "exp(-((x - (%.3f))^2 + (y - (%.3f))^2)/%s)"\n'
    return f"""# Narrow bumps of the running cost.

states = {{ x = {{}}, y = {{}} }}
controls = {{ u = {{}}, v = {{}} }}
dynamics = {{ x = "0.3*sin(3*x)*cos(3*x)+u", y = "0.3*sin(3*y)*cos(3*y)+v" }}
equilibrium = {{ x = 0, y = 0, u = 0, v = 0 }}
region = {{ x = [-2, 2], y = [-2, 2] }}

[cost]
running = "0.5*(u^2 + v^2) + 0.5*(x^2 + y^2)*(1 + {args.height}*({names}))"

[definitions]
""" + "".join(one % (i, *q, args.width) for i, q in enumerate(bumps))


def reference(bumps, args):
    x = np.linspace(-2.4, 2.4, NODES)
    X, Y = np.meshgrid(x, x, indexing="ij")
    q = np.ones_like(X)
    for p in bumps:
        q += args.height * np.exp(-((X - p[0]) ** 2 + (Y - p[1]) ** 2) / args.width)
    q *= 0.5 * (X**2 + Y**2)
    drift = (0.15 * np.sin(6 * X)) ** 2 + (0.15 * np.sin(6 * Y)) ** 2
    speed = 1 / np.sqrt(2 * q + drift + 1e-14)
    w = skfmm.travel_time(np.hypot(X, Y) - INNER, speed, dx=float(x[1] - x[0]), order=2)
    w = np.asarray(w) + np.sqrt(1.81) * INNER**2 / 2
    phi = 0.05 * np.sin(3 * X) ** 2 + 0.05 * np.sin(3 * Y) ** 2
    return RegularGridInterpolator((x, x), w + phi)


def states(rng, bumps, args):
    """On flanks, and behind bumps, in turn."""
    found = []
    for k in range(args.states):
        p = bumps[rng.integers(len(bumps))]
        if k % 2:
            r, t = np.sqrt(args.width) * rng.uniform(0.3, 2.5), rng.uniform(0, 2 * np.pi)
            s = p + r * np.array([np.cos(t), np.sin(t)])
        else:
            s = p * (1 + rng.uniform(0.03, 0.7)) + rng.normal(0, 0.06, 2)
        if np.all(abs(s) < 1.95):
            found.append(np.round(s, 8))
    return np.array(found)


def compare(answers, right):
    evidence, wrong = {}, 0
    for row, v in zip(answers, right):
        evidence[row["evidence"]] = evidence.get(row["evidence"], 0) + 1
        said = float(row["V"] or "nan")
        if not said <= v * (1 + ALLOWED) + 1e-4:
            wrong += 1
            print(f"  ({row['x']}, {row['y']}): {said:.6f}, {row['evidence']}; right {v:.6f}")
    print(f"{wrong} of {len(right)} states too large; evidence {evidence}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("costate")
    parser.add_argument("seed", type=int)
    parser.add_argument("--bumps", type=int, default=12)
    parser.add_argument("--height", type=float, default=100.0)
    parser.add_argument("--width", type=float, default=0.006)
    parser.add_argument("--states", type=int, default=300)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    bumps = centres(rng, args)
    asked = states(rng, bumps, args)
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        (folder / "bumps.toml").write_text(scene(bumps, args))
        np.savetxt(folder / "asked.csv", asked, delimiter=",", header="x,y", comments="", fmt="%.8f")
        command = [args.costate, "solve", "bumps.toml", "--points", "asked.csv", "--out", "said.csv"]
        command += ["--backend", "cpu", "--quiet"]
        subprocess.run(command, cwd=folder, check=True)
        with open(folder / "said.csv", newline="") as table:
            compare(list(csv.DictReader(table)), reference(bumps, args)(asked))


if __name__ == "__main__":
    main()
