"""Flights under a law that is any function of Python.

All flights are one batch: the function is called with the states of all, a stage of a step at a time, so
that its cost is that of arrays. J. R. Dormand and P. J. Prince, J. Comput. Appl. Math. 6 (1980), 19-26,
orders 5 and 4, each flight with the smallest step that one of them needs.
"""

from __future__ import annotations

from .errors import InputError

_STAGES = (
    (),
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
_ERROR = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)
_NAMES = {0: "time", 9: "step_floor", 10: "step_limit", 11: "not_finite"}
_FIRST_EVENT = 16
_MOST_STEPS = 1_000_000


def _checked(law, states, controls):
    """The law as a function of (N, states) with (N, controls)."""
    import numpy as np

    def call(x):
        u = np.asarray(law(x.copy()))
        if u.dtype == object or not np.can_cast(u.dtype, float, "same_kind"):
            raise InputError(f"the law gives {u.dtype}, which is no number")
        u = u.astype(float)
        count = len(x)
        if controls == 1 and u.shape in ((count,), ()):
            u = np.broadcast_to(u, (count,))[:, None]
        if u.shape == (controls,) and count == 1:
            u = u[None]
        if u.shape != (count, controls):
            raise InputError(
                f"the law gives the shape {u.shape} for states of the shape {x.shape}: needed is ({count}, {controls})"
            )
        return u

    return call


def fly(problem, system, law, x0, time, samples, rtol, tell):
    """Simulates from ``x0`` (flights, states) for ``time``; returns what a file would hold.

    Flights end where a guard is left (to the tolerance), or the state is no longer finite.
    """
    import numpy as np

    if system.events:
        raise InputError(
            f"events ({', '.join(system.events)}) are for the engine's laws: write the law as [closed_loop.law], or fit one"
        )
    n, m = len(problem.states), len(problem.controls)
    bounds = np.array(system.bounds, dtype=float).reshape(m, 2)
    widths = np.array([hi - lo for lo, hi in problem.region.values()])
    call = _checked(law, n, m)

    def controls(x):
        return np.clip(call(x), bounds[:, 0], bounds[:, 1])

    def rates(y):
        """Of the states and the cost so far."""
        u = np.ascontiguousarray(controls(y[:, :n]))
        x = np.ascontiguousarray(y[:, :n])
        return system.rates(x, u).reshape(-1, n + 1)

    def margins(x):
        return system.guards(np.ascontiguousarray(x)).reshape(len(x), len(system.guard_names))

    count = len(x0)
    y = np.hstack([x0, np.zeros((count, 1))])
    status = np.zeros(count, dtype=np.int32)
    t_end = np.full(count, float(time))
    alive = np.ones(count, dtype=bool)
    times = np.linspace(0.0, time, samples + 1) if samples else np.array([0.0, time])
    kept = np.full((count, len(times), n), np.nan)
    kept[:, 0] = x0
    for k, guard in enumerate(margins(x0).T if system.guard_names else ()):
        out = (guard < 0) & alive
        status[out], t_end[out], alive[out] = _FIRST_EVENT + k, 0.0, False

    floor = 1e-14 * time
    step = min(1e-3 * time, times[1])
    steps = 0
    for place in range(1, len(times)):
        t = times[place - 1]
        while t < times[place] - floor and alive.any():
            steps += 1
            if steps > _MOST_STEPS or step < floor:
                code = 10 if steps > _MOST_STEPS else 9
                status[alive], t_end[alive], alive = code, t, alive & False
                break
            h = min(step, times[place] - t)
            now = y[alive]
            slopes = []
            with np.errstate(all="ignore"):
                for weights in _STAGES:
                    at = now + h * sum((w * k for w, k in zip(weights, slopes)), 0 * now)
                    slopes.append(rates(at))
                after = at
                error = h * sum(w * k for w, k in zip(_ERROR, slopes))
                scale = rtol * (widths + np.maximum(abs(now[:, :n]), abs(after[:, :n])))
                off = np.sqrt(np.mean((error[:, :n] / scale) ** 2, axis=1))
            lost = ~np.isfinite(after).all(axis=1) | ~np.isfinite(off)
            # What is not finite is tried with smaller steps first.
            worst = np.inf if lost.any() and h > 1e-10 * time else off[~lost].max(initial=0.0)
            if worst > 1.0:
                step = h * max(0.1, 0.9 * worst**-0.2 if np.isfinite(worst) else 0.1)
                continue
            rows = np.flatnonzero(alive)
            t += h
            tell(t / time)
            y[rows[~lost]] = after[~lost]
            status[rows[lost]], t_end[rows[lost]], alive[rows[lost]] = 11, t - h, False
            for k, row in _left(system, margins, now, after, slopes[0], slopes[-1], h, rows, n):
                status[row[0]], t_end[row[0]], y[row[0], :n] = _FIRST_EVENT + k, t - h + row[1], row[2]
                alive[row[0]] = False
            step = h * min(5.0, 0.9 * max(worst, 1e-8) ** -0.2)
        kept[alive, place] = y[alive, :n]
    return {
        "x0": x0,
        "x_end": y[:, :n],
        "J": y[:, n],
        "t_end": t_end,
        "status": status,
        "times": times,
        "x": kept,
        "u": controls(kept.reshape(-1, n)).reshape(count, len(times), m)
        if np.isfinite(kept).all()
        else _controls_where_known(controls, kept, m),
    }


def _controls_where_known(controls, x, m):
    import numpy as np

    u = np.full((*x.shape[:-1], m), np.nan)
    known = np.isfinite(x).all(axis=-1)
    if known.any():
        u[known] = controls(x[known])
    return u


def _left(system, margins, now, after, before_rate, after_rate, h, rows, n):
    """Guards that flights have left in a step: (guard, (flight, time in the step, state there)), by
    bisection on the cubic through both ends."""
    import numpy as np

    if not system.guard_names:
        return []
    found = []
    outside = (margins(after[:, :n]) < 0).any(axis=1) & np.isfinite(after).all(axis=1)
    for j in np.flatnonzero(outside):
        a, b = now[j, :n], after[j, :n]
        p, q = h * before_rate[j, :n], h * after_rate[j, :n]

        def at(s):
            return (
                (1 + 2 * s) * (1 - s) ** 2 * a
                + s * (1 - s) ** 2 * p
                + s**2 * (3 - 2 * s) * b
                - s**2 * (1 - s) * q
            )

        low, high = 0.0, 1.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            if (margins(at(middle)[None]) < 0).any():
                high = middle
            else:
                low = middle
        x = at(high)
        guard = int(np.argmin(margins(x[None])[0]))
        found.append((guard, (rows[j], high * h, x)))
    return found


def tree(problem, system, done, time, name, rtol):
    """The same as an ``xarray.DataTree`` with the names of the engine's simulations."""
    import numpy as np
    import xarray as xr

    def described(kind, all_):
        names, units, words = (list(part) for part in zip(*all_)) if all_ else ([], [], [])
        filled = [u or "1" for u in units]
        return {
            kind: (kind, np.array(names, object), {"long_name": f"{kind} name"}),
            f"{kind}_units": (kind, np.array(filled, object), {"long_name": f"unit of each {kind}"}),
            f"{kind}_long_name": (
                kind,
                np.array([w or n for n, w in zip(names, words)], object),
                {"long_name": f"description of each {kind}"},
            ),
        }

    states = described("state", problem._scene.states)
    controls = described("control", problem._scene.controls)
    codes = {**_NAMES, **{_FIRST_EVENT + k: f"guard_{g}" for k, g in enumerate(system.guard_names)}}
    flags = {
        "long_name": "how the flight ended",
        "flag_values": np.array(list(codes), dtype=np.int32),
        "flag_meanings": " ".join(codes.values()),
    }
    count, places = done["x"].shape[:2]
    simulation = xr.Dataset(
        {
            "x0": (("flight", "state"), done["x0"], {"long_name": "state at the beginning"}),
            "x_end": (("flight", "state"), done["x_end"], {"long_name": "state at the end"}),
            "t_end": ("flight", done["t_end"], {"long_name": "time at the end"}),
            "J": ("flight", done["J"], {"long_name": "running cost until the end"}),
            "status": ("flight", done["status"], flags),
        },
        coords={"flight": np.arange(count), **states},
        attrs={
            "title": "flights forward in time under a law of Python",
            "time": float(time),
            "law": name,
            "backend": "python",
            "precision": "f64",
            "method": "dopri5",
            "rtol": rtol,
        },
    )
    known = np.isfinite(done["x"]).all(axis=-1)
    flight, place = np.nonzero(known)
    samples = xr.Dataset(
        {
            "flight": ("sample", flight.astype(np.int32), {"long_name": "index of the flight in /simulation"}),
            "phase": ("sample", np.zeros(len(flight), np.int32), {"long_name": "index of the phase within the flight"}),
            "t": ("sample", done["times"][place], {"long_name": "time"}),
            "x": (("sample", "state"), done["x"][known], {"long_name": "state"}),
            "u": (("sample", "control"), done["u"][known], {"long_name": "control"}),
        },
        coords={"sample": np.arange(len(flight)), **states, **controls},
        attrs={"title": "points of the flights of /simulation"},
    )
    return xr.DataTree.from_dict({"/simulation": simulation, "/simulation_samples": samples})
