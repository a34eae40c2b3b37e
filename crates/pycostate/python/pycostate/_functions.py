"""Flights under a law that is any function of Python.

All flights are one batch: the function is called with the states of all, a stage of a step at a time, so
that its cost is that of arrays. J. R. Dormand and P. J. Prince, J. Comput. Appl. Math. 6 (1980), 19-26,
orders 5 and 4, each flight with steps of its own. Where the condition of an event comes true in a step, the
step is taken again, shorter, until it ends there.
"""

from __future__ import annotations

import inspect
import time as clock

from ._places import numbers
from .errors import InputError, OutOfTime

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
#: How flights end, by the engine's codes.
_TIME, _EVENTS, _ZENO, _NOT_LOCATED, _NO_STATE, _NO_CONDITION = range(6)
_STEP_FLOOR, _STEP_LIMIT, _NOT_FINITE, _CONTACT_LOST = 9, 10, 11, 12
_FIRST_EVENT = 16
_MOST_STEPS = 1_000_000
#: Relative tolerance of a step, unless another one is asked for.
_RTOL = 1e-8
#: Steps shorter than this, relative to the whole time, are none.
_FLOOR = 1e-14
_TINY = 1e-300
#: What cannot be computed is tried with steps down to this, and so are conditions that may come true
#: and false again in a step.
_LEAST, _LEAST_LOOK = 1e-10, 1e-6
#: A condition is on its surface within this, relative to its size.
_TOUCH = 1e-12
#: So many phases in a row, shorter than this share of the time so far, are too many.
_MOST_SHORT, _SHORT = 20, 1e-9
_CORRECTIONS = 100
#: A cubic through both ends of a step of sin t misses it by (t^2/2)^2 over three times this.
_QUARTIC = 32
#: Times of stages, in their order, as shares of a step.
_LOOKED_AT = ((0.0, 0), (1 / 5, 1), (3 / 10, 2), (4 / 5, 3), (8 / 9, 4), (1.0, 6))


def _knows_time(law) -> bool:
    """Whether a function has a parameter ``t``."""
    try:
        return "t" in inspect.signature(law).parameters
    except (TypeError, ValueError):
        return False


def _checked(law, controls):
    """The law as a function of states (N, states) and times (N,), with (N, controls)."""
    import numpy as np

    knows_time = _knows_time(law)

    def call(x, t):
        u = law(x.copy(), t=t.copy()) if knows_time else law(x.copy())
        u = numbers(u, "what the law gives")
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


class _Flights:
    """Flights as arrays: each has a time, a step and a phase of its own."""

    def __init__(self, problem, system, law, x0, *, time, events, rtol, stops, begin=None, watches=True):
        """``stops`` (flights, count): times at which states are kept, of which the last is the end;
        ``begin``: times at which flights begin. ``watches``: whether events and guards are."""
        import numpy as np

        count = len(x0)
        self.system, self.time, self.rtol, self.most = system, time, rtol, events
        self.n, self.m = len(problem.states), len(problem.controls)
        self.bounds = np.array(system.bounds, dtype=float).reshape(self.m, 2)
        self.widths = np.array([hi - lo for lo, hi in problem.region.values()])
        self.sizes = np.array(system.sizes if watches else [], dtype=float)
        self.touch = _TOUCH * self.sizes
        #: Of conditions: those that follow are guards, which hold on their surface.
        self.jumps_at = len(system.events) if watches else 0
        self.law = _checked(law, self.m)
        self.stops = stops

        self.y = np.hstack([x0, np.zeros((count, 1))])
        self.t = np.zeros(count) if begin is None else begin.copy()
        self.step = np.minimum(1e-3 * time, stops[:, 0] - self.t)
        #: The largest running cost so far.
        self.cost_rate = np.zeros(count)
        self.steps = np.zeros(count, dtype=int)
        self.stop = np.zeros(count, dtype=int)
        self.alive = np.ones(count, dtype=bool)
        self.status = np.zeros(count, dtype=np.int32)
        self.phase = np.zeros(count, dtype=np.int32)
        #: When phases began, and where.
        self.begun = self.t.copy()
        self.begun_at = x0.copy()
        self.short = np.zeros(count, dtype=int)
        #: Conditions at the last step's end, and their rates; which are waited for; which of these have
        #: not left their surface yet.
        self.ahead = np.zeros((count, len(self.sizes)))
        self.slope = np.zeros((count, len(self.sizes)))
        self.armed = np.zeros((count, len(self.sizes)), dtype=bool)
        self.fresh = np.zeros((count, len(self.sizes)), dtype=bool)
        #: (flight, stop, state); (flight, phase, begin, state there, end, state there).
        self.samples: list = []
        self.phases: list = []
        self.jumps: list = []
        self.begin(np.arange(count))

    def controls(self, x, t):
        import numpy as np

        if not len(x):
            return np.zeros((0, self.m))
        u = np.clip(self.law(x, t), self.bounds[:, 0], self.bounds[:, 1])
        return np.ascontiguousarray(u)

    def rates(self, y, t):
        """Of the states and the cost so far; the controls."""
        import numpy as np

        x = np.ascontiguousarray(y[:, : self.n])
        u = self.controls(x, t)
        return self.system.rates(x, u).reshape(-1, self.n + 1), u

    def conditions(self, x, u):
        """Conditions, positive until they come true; their rates; where they count."""
        import numpy as np

        if not len(self.sizes):
            return np.zeros((3, len(x), 0))
        found = self.system.conditions(np.ascontiguousarray(x), u)
        return np.moveaxis(found.reshape(len(x), 3, len(self.touch)), 1, 0)

    def end(self, flight, code, *, flown=True):
        """``flown``: in a phase that has begun."""
        if flown:
            self.close(flight)
        self.status[flight], self.alive[flight] = code, False

    def close(self, flight):
        """The end of a phase."""
        begin = self.begun[flight], self.begun_at[flight].copy()
        end = self.t[flight], self.y[flight, : self.n].copy()
        self.phases.append((int(flight), int(self.phase[flight]), *begin, *end))

    def at_stop(self, flight):
        self.t[flight] = self.stops[flight, self.stop[flight]]
        self.samples.append((int(flight), int(self.stop[flight]), self.y[flight, : self.n].copy()))
        self.stop[flight] += 1
        if self.stop[flight] == self.stops.shape[1]:
            self.end(flight, _TIME)

    def is_met(self, ahead):
        """Whether conditions are true; guards hold on their surface."""
        import numpy as np

        met = ahead <= 0
        met[..., self.jumps_at :] = ahead[..., self.jumps_at :] < 0
        return met & ~np.isnan(ahead)

    # Phases.

    def begin(self, flights):
        """What flights wait for when a phase begins; some end there."""
        import numpy as np

        if not len(self.touch):
            return
        x = self.y[flights, : self.n]
        ahead, slope, _ = self.conditions(x, self.controls(x, self.t[flights]))
        on = abs(ahead) <= self.touch
        self.ahead[flights], self.slope[flights] = ahead, slope
        self.fresh[flights] = on & (slope > 0)
        self.armed[flights] = np.where(on, slope > 0, ahead > 0)
        outside = (ahead < -self.touch) | on & (slope < 0)
        # Guards are asked for wherever a phase begins.
        self.armed[flights, self.jumps_at :] = True
        self.fresh[flights, self.jumps_at :] = on[:, self.jumps_at :]
        for row, flight in enumerate(flights):
            left = np.flatnonzero(outside[row, self.jumps_at :])
            if np.isnan(ahead[row]).any():
                self.end(flight, _NO_CONDITION)
            elif left.size:
                self.end(flight, _FIRST_EVENT + self.jumps_at + left[0])

    def happen(self, flight, event, ahead, slope, counts):
        """An event at the end of a phase; ``ahead``, ``slope`` and ``counts`` are those of all conditions
        there."""
        import numpy as np

        before = self.y[flight, : self.n].copy()
        jump = self.system.jump(event, before.tolist())
        if jump is None:
            self.end(flight, _FIRST_EVENT + event)
            return
        self.close(flight)
        after, is_lost = np.array(jump[0]), jump[1]
        self.jumps.append((int(flight), event, self.t[flight], before, after))
        self.y[flight, : self.n] = after
        flown = self.t[flight] - self.begun[flight]
        self.short[flight] = self.short[flight] + 1 if flown <= _SHORT * self.t[flight] else 0
        self.phase[flight] += 1
        self.begun[flight], self.begun_at[flight] = self.t[flight], after
        # Others that come true at this moment, where they did so before the jump.
        due = self.armed[flight] & (abs(ahead) <= self.touch) & (slope < 0)
        due[event] = False
        due[self.jumps_at :] = False
        next_ = None
        if np.isfinite(after).all():
            u = self.controls(after[None], self.t[[flight]])
            there, leaves, counts_there = (c[0] for c in self.conditions(after[None], u))
            goes_in = (abs(there) <= self.touch) & (leaves < 0)
            for other in np.flatnonzero(due):
                ends = self.system.jump(other, after.tolist()) is None
                # It ends the flight when those before it have happened, unless these led away.
                if ends and counts[other] >= 0 and (next_ is None or not goes_in[other]):
                    return self.end(flight, _FIRST_EVENT + other, flown=False)
                # What has happened by then decides.
                if next_ is None and goes_in[other]:
                    if np.isnan(counts_there[other]):
                        return self.end(flight, _NO_CONDITION, flown=False)
                    if counts_there[other] >= 0:
                        next_ = other
        if not np.isfinite(after).all():
            return self.end(flight, _NO_STATE, flown=False)
        if self.short[flight] >= _MOST_SHORT:
            return self.end(flight, _ZENO, flown=False)
        if self.phase[flight] >= self.most:
            return self.end(flight, _EVENTS, flown=False)
        if is_lost:
            return self.end(flight, _CONTACT_LOST, flown=False)
        if next_ is not None:
            self.armed[flight] = due
            return self.happen(flight, int(next_), there, leaves, counts_there)
        return self.begin(np.array([flight]))

    # Steps.

    def try_step(self, now, t, h):
        """A step each: the end, errors of the states, the cost and the conditions, conditions at the end,
        the largest running cost on the way, conditions at the stages."""
        import numpy as np

        slopes: list = []
        along: list = []
        for weights in _STAGES:
            at = now + h[:, None] * sum((w * k for w, k in zip(weights, slopes)), 0 * now)
            rates, u = self.rates(at, t + h * sum(weights))
            slopes.append(rates)
            along.append(self.conditions(at[:, : self.n], u))
        most = np.max([abs(k[:, self.n]) for k in slopes], axis=0)
        moves = [np.nan_to_num(c[1], nan=0.0, posinf=0.0, neginf=0.0) for c in along]
        both = [np.hstack(pair) for pair in zip(slopes, moves)]
        error = h[:, None] * sum(w * k for w, k in zip(_ERROR, both))
        return at, error, along[-1], most, along

    def advance(self):
        """One step of every flight that still flies, or a shorter one to be tried next."""
        import numpy as np

        rows = np.flatnonzero(self.alive)
        self.steps[rows] += 1
        floor = _FLOOR * self.time
        over = self.steps[rows] > _MOST_STEPS
        low = self.step[rows] < floor
        for flight in rows[over | low]:
            self.end(flight, self.why_so_short(flight))
        rows = rows[~(over | low)]
        if not rows.size:
            return
        # An event may have come at a stop.
        to_stop = self.stops[rows, self.stop[rows]] - self.t[rows]
        near = to_stop <= 4 * 2.0**-52 * self.time
        for flight in rows[near]:
            self.at_stop(flight)
        rows, to_stop = rows[~near], to_stop[~near]
        if not rows.size:
            return
        stops = self.step[rows] >= to_stop
        h = np.where(stops, to_stop, self.step[rows])
        now = self.y[rows]
        with np.errstate(all="ignore"):
            after, error, conditions, cost_rate, along = self.try_step(now, self.t[rows], h)
            ahead, slope, _ = conditions
            cost_rate = np.fmax(cost_rate, self.cost_rate[rows])
            scale = np.maximum(abs(now), abs(after))
            scale[:, : self.n] += self.widths
            scale[:, self.n] += cost_rate * (self.t[rows] + h) + _TINY
            scale = np.hstack([scale, np.broadcast_to(self.sizes, ahead.shape)])
            off = np.sqrt(np.mean((error / (self.rtol * scale)) ** 2, axis=1))

        # What is not finite, or no number, is tried with shorter steps first.
        lost = ~np.isfinite(after).all(axis=1) | ~np.isfinite(off)
        unknown = np.isnan(ahead).any(axis=1) & ~lost
        bad = lost | unknown
        ends = bad & (h <= _LEAST * self.time)
        for row in np.flatnonzero(ends):
            self.end(rows[row], _NOT_FINITE if lost[row] else _NO_CONDITION)
        worst = np.where(bad, np.inf, off)
        with np.errstate(all="ignore"):
            factor = np.where(bad, 0.1, np.clip(0.9 * np.maximum(off, 1e-8) ** -0.2, 0.1, 5.0))
        again = (worst > 1.0) & ~ends
        self.step[rows[again]] = h[again] * np.minimum(factor[again], 0.9)

        # So are steps in which a condition may come true and false again, or in which it has not left
        # its surface.
        met = self.is_met(ahead) & self.armed[rows]
        fresh = self.fresh[rows]
        returns = (met & fresh).any(axis=1)
        dips = self.dips(rows, along, h) & (h > _LEAST_LOOK * self.time)
        closer = (returns | dips) & ~again & ~ends
        self.step[rows[closer]] = 0.5 * h[closer]

        good = ~(again | ends | closer)
        crosses = good & met.any(axis=1)
        calm = good & ~crosses
        self.cost_rate[rows[good]] = cost_rate[good]
        self.move(rows[calm], after[calm], ahead[calm], slope[calm])
        self.t[rows[calm]] += h[calm]
        # A step that a stop has cut says little of how long the next one may be.
        long = np.where(stops, np.maximum(h * factor, self.step[rows]), h * factor)
        self.step[rows[calm]] = long[calm]
        for flight in rows[calm & stops]:
            self.at_stop(flight)
        if crosses.any():
            self.meet(rows[crosses], h[crosses], met[crosses])

    def why_so_short(self, flight):
        """Why steps of a flight are too many, or too short."""
        import numpy as np

        if self.steps[flight] > _MOST_STEPS:
            return _STEP_LIMIT
        fresh = np.flatnonzero(self.fresh[flight])
        if not fresh.size:
            return _STEP_FLOOR
        # It cannot leave a surface that it is on.
        return _ZENO if fresh[0] < self.jumps_at else _FIRST_EVENT + fresh[0]

    def move(self, flights, after, ahead, slope):
        self.y[flights] = after
        self.ahead[flights], self.slope[flights] = ahead, slope
        self.fresh[flights] &= ahead <= 0
        self.armed[flights] |= ahead > 0

    def dips(self, rows, along, h):
        """Whether a condition may come true and false again in a step, or false and true: at a stage, or
        on the cubics between stages. Those that are true at the end of a step are met anyway."""
        import numpy as np

        if not len(self.touch):
            return np.zeros(len(rows), dtype=bool)
        armed = self.armed[rows]
        sign = np.where(armed, 1.0, -1.0)
        first, last = self.ahead[rows], along[-1][0]
        # Of what is waited for, and has not come by the end; of what is true, and is so again.
        looks = np.where(armed, last > 0, (first < -self.touch) & (last < -self.touch))
        found = np.zeros_like(looks)
        with np.errstate(all="ignore"):
            # States at stages are known roughly: between the ends the cubic is better, if it has to bend
            # once.
            for (s0, k0), (s1, k1) in [*zip(_LOOKED_AT, _LOOKED_AT[1:]), (_LOOKED_AT[0], _LOOKED_AT[-1])]:
                width = (s1 - s0) * h[:, None]
                a, b = sign * along[k0][0], sign * along[k1][0]
                if k0 == 0:
                    # What is on its surface has just left it.
                    a = np.maximum(a, 0.0)
                p, q = width * sign * along[k0][1], width * sign * along[k1][1]
                # a + p s + c s^2 + d s^3
                c, d = 3 * (b - a) - 2 * p - q, p + q - 2 * (b - a)
                # What the cubic leaves out goes with the fourth power of the step, as does this.
                off = np.maximum(abs(c), abs(c + 3 * d)) ** 2 / (_QUARTIC * self.sizes)
                if k0:
                    found |= a < 0
                root = np.sqrt(c * c - 3 * d * p)
                for s in ((-c + root) / (3 * d), (-c - root) / (3 * d), -p / (2 * c)):
                    inside = (s > 0) & (s < 1)
                    found |= inside & (((d * s + c) * s + p) * s + a < off)
        return (found & looks).any(axis=1)

    def meet(self, flights, h, met):
        """Steps in which conditions come true: to where the first does so."""
        import numpy as np

        count = len(flights)
        now = self.y[flights]
        size = np.where(met, self.touch / _TOUCH, 1.0)

        def least(ahead):
            return np.where(met, ahead / size, np.inf).min(axis=1)

        low, high = np.zeros(count), np.ones(count)
        g_low, g_high = least(self.ahead[flights]), np.full(count, -1.0)
        # Illinois' method: the end that has stayed counts half; every third time the middle.
        stayed = np.zeros(count, dtype=int)
        share, found = np.ones(count), None
        for turn in range(_CORRECTIONS):
            with np.errstate(all="ignore"):
                at, _, conditions, *_ = self.try_step(now, self.t[flights], share * h)
            ahead, slope, counts = conditions
            g = least(ahead)
            true = (self.is_met(ahead) & met).any(axis=1)
            if found is None:
                found = [at.copy(), ahead.copy(), slope.copy(), counts.copy()]
            for stored, new in zip(found, (at, ahead, slope, counts)):
                stored[true] = new[true]
            g_low = np.where(true, np.where(stayed == 1, 0.5 * g_low, g_low), g)
            g_high = np.where(true, g, np.where(stayed == -1, 0.5 * g_high, g_high))
            stayed = np.where(true, 1, -1)
            low, high = np.where(true, low, share), np.where(true, share, high)
            narrow = (high - low) * h <= 2.0 ** -52 * (self.t[flights] + high * h)
            if (narrow | (true & (abs(g) <= 2.0**-52))).all():
                break
            with np.errstate(all="ignore"):
                share = low + (high - low) * g_low / (g_low - g_high)
            middle = ~((share > low) & (share < high)) | (turn % 3 == 2)
            share = np.where(middle, 0.5 * (low + high), share)

        at, ahead, slope, counts = found
        self.t[flights] += high * h
        for row, flight in enumerate(flights):
            self.move(flight, at[row], ahead[row], slope[row])
            # Of those at this moment the first in the scene that counts.
            here = np.flatnonzero(met[row] & (ahead[row] <= self.touch))
            counting = [k for k in here if k >= self.jumps_at or not counts[row, k] < 0]
            first = counting[0] if counting else None
            if first is None:
                # They are passed by.
                self.armed[flight, here] = False
            elif first >= self.jumps_at:
                self.end(flight, _FIRST_EVENT + first)
            elif np.isnan(counts[row, first]):
                self.end(flight, _NO_CONDITION)
            else:
                self.happen(flight, int(first), ahead[row], slope[row], counts[row])


def fly(problem, system, law, x0, options, how):
    """Simulates from ``x0`` (flights, states); returns what is written."""
    import numpy as np

    rtol = _RTOL if how["rtol"] is None else how["rtol"]
    time, samples = options["time"], options["samples"]
    until = None if how["time_limit"] is None else clock.monotonic() + how["time_limit"]

    def flown(x0, stops, **more):
        flights = _Flights(
            problem, system, law, x0, time=time, events=options["events"], rtol=rtol, stops=stops, **more
        )
        while flights.alive.any():
            share = flights.t[flights.alive].min() / time
            if until is not None and clock.monotonic() > until:
                raise OutOfTime(
                    f"the time limit came when {100 * share:.0f} % were flown (a law that chatters takes ever shorter steps)"
                )
            flights.advance()
            if how["progress"] is not None:
                how["progress"](f"simulated: {100 * share:.0f} %")
        return flights

    # Points lie evenly in each phase: how long it is is known when it is over, and it is flown again.
    shares = np.linspace(0.0, 1.0, samples + 1)[1:] if samples else np.ones(1)
    watches = bool(system.sizes)
    first = np.ones(1) if watches else shares
    flights = flown(x0, np.tile(time * first, (len(x0), 1)))
    phases = sorted(flights.phases, key=lambda p: p[:2])
    kept: list = []
    if samples:
        lasting = [p for p in phases if p[4] - p[2] > 1e-12 * time]
        # Without any a flight may still end early.
        if lasting and (watches or (flights.status != _TIME).any()):
            begin = np.array([p[2] for p in lasting])
            stops = begin[:, None] + np.array([p[4] - p[2] for p in lasting])[:, None] * shares
            stops[:, -1] = [p[4] for p in lasting]
            again = flown(np.array([p[3] for p in lasting]), stops, begin=begin, watches=False)
        else:
            again, stops = flights, flights.stops
        points: dict = {}
        for number, stop, x in again.samples:
            points.setdefault(number, []).append((stops[number, stop], x))
        number = 0
        for phase in phases:
            flight, count, t0, start, t1, last = phase
            kept.append((flight, count, t0, start))
            if t1 - t0 > 1e-12 * time:
                own = points.get(number, [])
                number += 1
                kept += [(flight, count, t, x) for t, x in own if t < t1]
                kept.append((flight, count, t1, last))
            elif t1 > t0:
                kept.append((flight, count, t1, last))
    jumps = sorted(flights.jumps, key=lambda j: j[0])

    def states(rows, k):
        return np.array([row[k] for row in rows], dtype=float).reshape(len(rows), flights.n)

    x = states(kept, 3)
    return {
        "x0": x0,
        "x_end": np.ascontiguousarray(flights.y[:, : flights.n]),
        "cost": flights.y[:, flights.n].tolist(),
        "t_end": flights.t.tolist(),
        "events": flights.phase.tolist(),
        "status": flights.status.tolist(),
        "jumps": [(flight, event, float(t)) for flight, event, t, _, _ in jumps],
        "before": states(jumps, 3),
        "after": states(jumps, 4),
        "samples": [(flight, phase, float(t)) for flight, phase, t, _ in kept],
        "x": x,
        "u": flights.controls(x, np.array([float(s[2]) for s in kept])),
        "law": getattr(law, "__qualname__", type(law).__name__),
        "rtol": rtol,
        "time": time,
    }
