"""The compressor's box by scipy.integrate.solve_bvp: 378 boundary value problems of the scene
scenarios/moore_greitzer.toml, each warm-started from its neighbour's solution, by halved steps where
that fails; one thread.

    python benches/peers/solve_bvp.py OUT.npz [PHI PSI R]        (9 7 6)

The infinite horizon is cut at T = 20, with the Riccati solution as the terminal cost. Prints one line
of JSON; V and p at each state go to OUT.npz.
"""

import json
import sys
import time
import warnings

import numpy as np
from scipy.integrate import solve_bvp
from scipy.linalg import solve_continuous_are

# Iterates of a failing problem overflow.
warnings.simplefilter("ignore")

PHI0, SIGMA, BETA, V_MAX, PSI_C0, T = 1.2, 4.0, 1.0, 0.1, 0.1469, 20.0


def characteristic(phi):
    return PSI_C0 + 1 + 1.5 * phi - 0.5 * phi**3


def slope(phi):
    return 1.5 - 1.5 * phi**2


PSI0 = characteristic(PHI0)
GAMMA0 = (PHI0 + 1) / np.sqrt(PSI0)
REST = np.array([PHI0, PSI0, 0.0, GAMMA0])
A = np.array(
    [
        [slope(PHI0), -1, -3 * PHI0, 0],
        [1 / BETA**2, -GAMMA0 / (2 * np.sqrt(PSI0)) / BETA**2, 0, -np.sqrt(PSI0) / BETA**2],
        [0, 0, SIGMA * (1 - PHI0**2), 0],
        [0, 0, 0, 0],
    ]
)
P = solve_continuous_are(A, np.array([[0], [0], [0], [1.0]]), 2 * np.eye(4), np.array([[2.0]]))


def rates(_, y):
    """Of the state, the adjoint and the cost to go."""
    phi, psi, r, gamma, a, b, c, d, _ = y
    psi = np.maximum(psi, 1e-6)
    v = np.clip(-d / 2, -V_MAX, V_MAX)
    root = np.sqrt(psi)
    return np.array(
        [
            -psi + characteristic(phi) - 3 * phi * r,
            (phi + 1 - gamma * root) / BETA**2,
            SIGMA * r * (1 - phi * phi - r),
            v,
            -(2 * (phi - PHI0) + a * (slope(phi) - 3 * r) + b / BETA**2 - 2 * c * SIGMA * r * phi),
            -(2 * (psi - PSI0) - a - b * gamma / (2 * root) / BETA**2),
            -(2 * r - 3 * phi * a + c * SIGMA * (1 - phi * phi - 2 * r)),
            -(2 * (gamma - GAMMA0) - b * root / BETA**2),
            -((phi - PHI0) ** 2 + (psi - PSI0) ** 2 + r**2 + (gamma - GAMMA0) ** 2 + v * v),
        ]
    )


def solve(x0, guess):
    def ends(ya, yb):
        e = yb[:4] - REST
        return np.concatenate([ya[:4] - x0, yb[4:8] - P @ e, [yb[8] - 0.5 * e @ P @ e]])

    return solve_bvp(rates, ends, *guess, tol=1e-6, max_nodes=20000)


def walk(start, goal, guess, depth=0):
    solution = solve(goal, guess)
    if solution.status == 0 or depth > 5:
        return solution
    middle = 0.5 * (start + goal)
    halfway = walk(start, middle, guess, depth + 1)
    return halfway if halfway.status != 0 else walk(middle, goal, thinned(halfway), depth + 1)


def thinned(solution):
    if len(solution.x) <= 600:
        return solution.x, solution.y
    t = np.linspace(0, T, 401)
    return t, solution.sol(t)


def main():
    counts = [int(a) for a in sys.argv[2:5]] or [9, 7, 6]
    phi, psi, r = (np.linspace(*of) for of in zip((1.0, 1.6, 0.0), (1.4, 2.2, 0.2), counts))
    t, y = np.linspace(0, T, 201), np.zeros((9, 201))
    y[:4] = REST[:, None]
    guess, at = (t, y), REST.copy()
    states, values, adjoints, solved = [], [], [], []
    clock = time.perf_counter()
    for k in range(counts[2]):
        for i in range(counts[0] - 1, -1, -1):
            # To and fro, so that the next state is always a neighbour.
            there = range(counts[1]) if i % 2 == 0 else range(counts[1] - 1, -1, -1)
            for j in there:
                x = np.array([phi[i], psi[j], r[k], GAMMA0])
                solution = walk(at, x, guess)
                if solution.status == 0:
                    at, guess = x, thinned(solution)
                states.append(x)
                solved.append(solution.status == 0)
                values.append(solution.y[8, 0])
                adjoints.append(solution.y[4:8, 0])
    seconds = time.perf_counter() - clock
    np.savez(sys.argv[1], x=states, V=values, p=adjoints, solved=solved)
    line = {"tool": "scipy.solve_bvp, one thread, tol 1e-6", "states": len(values)}
    print(json.dumps(line | {"solved": int(sum(solved)), "seconds": seconds}))


main()
