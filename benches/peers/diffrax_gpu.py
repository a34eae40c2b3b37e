"""The work of benches/shoot_out.rs by diffrax (Tsit5, vmap, jit) on whatever JAX finds.

    python benches/peers/diffrax_gpu.py 16384 1048576

One JSON line a setting: seconds (median of 3, results left on the device), traj_per_s, and where
there are at most 16384 trajectories max_rel_err against diffrax in f64 at 1e-12.
"""

import json
import sys
import time

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pendulum

jax.config.update("jax_enable_x64", True)


def van_der_pol_seeds(count):
    by = np.array([0.7548776662466928, 0.5698402909980533])[:, None]
    return 4 * ((0.5 + np.arange(count) * by) % 1) - 2


def van_der_pol(t, y, _):
    return jnp.array([y[1], (1 - y[0] ** 2) * y[1] - y[0]])


def run(rate, until, seeds, tolerance, dtype):
    def one(y0):
        number = lambda x: jnp.asarray(x, dtype)
        control = dfx.PIDController(rtol=tolerance, atol=tolerance)
        solution = dfx.diffeqsolve(
            dfx.ODETerm(rate), dfx.Tsit5(), number(0.0), number(until), number(0.01), y0,
            stepsize_controller=control, max_steps=100_000, saveat=dfx.SaveAt(t1=True),
        )
        return solution.ys[0]

    go = jax.jit(jax.vmap(one))
    y = jnp.asarray(seeds.T, dtype)
    go(y).block_until_ready()
    times = []
    for _ in range(3):
        begin = time.perf_counter()
        end = go(y).block_until_ready()
        times.append(time.perf_counter() - begin)
    return sorted(times)[1], np.asarray(end, np.float64).T


for count in map(int, sys.argv[1:]):
    cases = [
        ("pendulum", pendulum.rate_with(jnp), 4.0, pendulum.seeds(count)),
        ("van_der_pol", van_der_pol, 20.0, van_der_pol_seeds(count)),
    ]
    for name, rate, until, seeds in cases:
        exact = run(rate, until, seeds, 1e-12, jnp.float64)[1] if count <= 16384 else None
        for dtype, tolerances in ((jnp.float32, (1e-3, 1e-5)), (jnp.float64, (1e-3, 1e-6))):
            for tolerance in tolerances:
                seconds, end = run(rate, until, seeds, tolerance, dtype)
                row = {
                    "peer": "diffrax", "device": jax.devices()[0].device_kind, "work": name,
                    "precision": dtype.__name__, "setting": f"rtol={tolerance:g}", "n": count,
                    "seconds": seconds, "traj_per_s": count / seconds,
                }
                if exact is not None:
                    error = np.abs(end - exact) / np.maximum(np.abs(exact), 1)
                    row["max_rel_err"] = float(error.max())
                print(json.dumps(row), flush=True)
