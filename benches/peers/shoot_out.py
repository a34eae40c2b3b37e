"""The work of benches/shoot_out.rs by heyoka, numba and diffrax, on two threads of the CPU.

    python benches/peers/shoot_out.py 16384 [heyoka] [numba] [diffrax]

Seeds on s'Ps/2 = 1e-4 at equal angles in the coordinates where P is the identity, integrated 4 time
units backward. One JSON line a setting: peer, setting, n, seconds (compilation not counted),
traj_per_s, max_rel_err and median_rel_err of (theta, omega, p1, p2, V) at the end, against heyoka at
a tolerance of 1e-18. Without names all three run.
"""

import copy
import json
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import heyoka as hy
import numpy as np
from pendulum import g, q, r, rate_with, seeds, steady, xf

TIME = 4.0
THREADS = 2


def by_heyoka(count, tolerance, batch=32):
    """Taylor series in SIMD batches, f64."""
    symbols = hy.make_vars("x1", "x2", "p1", "p2", "V")
    expressions = SimpleNamespace(sin=hy.sin, cos=hy.cos, array=list)
    equations = list(zip(symbols, rate_with(expressions)(0.0, symbols, None)))
    start = seeds(count)
    made = hy.taylor_adaptive_batch(
        equations, np.ascontiguousarray(start[:, :batch]), tol=tolerance
    )
    end = np.empty_like(start)

    def work(firsts):
        own = copy.deepcopy(made)
        for i in firsts:
            own.set_time(0.0)
            own.state[:] = start[:, i : i + batch]
            own.propagate_until([TIME] * batch)
            end[:, i : i + batch] = own.state

    firsts = list(range(0, count, batch))
    parts = [firsts[k::THREADS] for k in range(THREADS)]
    begin = time.perf_counter()
    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(work, parts))
    return time.perf_counter() - begin, end


def by_numba(count, steps):
    """Runge-Kutta of order 4 with fixed steps, f64, compiled."""
    import numba as nb

    nb.set_num_threads(THREADS)

    @nb.njit
    def rate(y, to):
        u = steady - y[3] / r
        e = y[0] - xf
        to[0] = -y[1]
        to[1] = g * np.sin(y[0]) - u
        to[2] = q * e - g * np.cos(y[0]) * y[3]
        to[3] = q * y[1] + y[2]
        to[4] = 0.5 * (q * e * e + q * y[1] * y[1] + r * (u - steady) ** 2)

    @nb.njit(parallel=True)
    def run(start, steps):
        n = start.shape[1]
        end = np.empty_like(start)
        h = TIME / steps
        for i in nb.prange(n):
            y = start[:, i].copy()
            k1, k2, k3, k4, z = np.empty(5), np.empty(5), np.empty(5), np.empty(5), np.empty(5)
            for _ in range(steps):
                rate(y, k1)
                for j in range(5):
                    z[j] = y[j] + 0.5 * h * k1[j]
                rate(z, k2)
                for j in range(5):
                    z[j] = y[j] + 0.5 * h * k2[j]
                rate(z, k3)
                for j in range(5):
                    z[j] = y[j] + h * k3[j]
                rate(z, k4)
                for j in range(5):
                    y[j] += h / 6 * (k1[j] + 2 * k2[j] + 2 * k3[j] + k4[j])
            for j in range(5):
                end[j, i] = y[j]
        return end

    run(seeds(8), 10)
    start = seeds(count)
    begin = time.perf_counter()
    end = run(start, steps)
    return time.perf_counter() - begin, end


def by_diffrax(count, tolerance):
    """Tsit5, vmap, jit, f64."""
    import diffrax as dfx
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)

    def one(start):
        control = dfx.PIDController(rtol=tolerance, atol=tolerance)
        return dfx.diffeqsolve(
            dfx.ODETerm(rate_with(jnp)),
            dfx.Tsit5(),
            0.0,
            TIME,
            0.01,
            start,
            stepsize_controller=control,
            max_steps=100000,
            saveat=dfx.SaveAt(t1=True),
        ).ys[0]

    run = jax.jit(jax.vmap(one))
    start = jnp.asarray(seeds(count).T)
    run(start).block_until_ready()
    begin = time.perf_counter()
    end = run(start).block_until_ready()
    return time.perf_counter() - begin, np.asarray(end).T


PEERS = {
    "heyoka": ("tol", by_heyoka, (1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 2.3e-16)),
    "numba": ("steps", by_numba, (100, 400, 1600)),
    "diffrax": ("rtol", by_diffrax, (1e-4, 1e-6, 1e-8, 1e-10)),
}


def main():
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 16384
    names = sys.argv[2:] or list(PEERS)
    reference = by_heyoka(count, 1e-18)[1]
    scale = np.maximum(np.abs(reference), 1.0)
    for name in names:
        word, run, settings = PEERS[name]
        for setting in settings:
            seconds, end = run(count, setting)
            errors = np.max(np.abs(end - reference) / scale, axis=0)
            row = {
                "peer": name,
                "setting": f"{word}={setting:g}",
                "n": count,
                "seconds": seconds,
                "traj_per_s": count / seconds,
                "max_rel_err": float(errors.max()),
                "median_rel_err": float(np.median(errors)),
            }
            print(json.dumps(row), flush=True)


main()
