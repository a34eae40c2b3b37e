"""V at any state."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from . import _engine, _files, _options
from ._places import Places, identifier, numbers, states_of
from .errors import InputError

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr

    from ._problem import Problem


#: States that are asked for at once: a part of a second.
_PART = 500_000


def _parts(rows: np.ndarray) -> Iterator[np.ndarray]:
    for first in range(0, len(rows), _PART):
        yield rows[first : first + _PART]


def counts_of(names: Sequence[str], counts) -> list[int]:
    """Points along each axis of a grid over the region."""
    default = {1: 401, 2: 101, 3: 41, 4: 15}.get(len(names), 5)
    if counts is None:
        return [default] * len(names)
    if isinstance(counts, Mapping):
        unknown = [name for name in counts if name not in names]
        if unknown:
            raise InputError(f"counts: {unknown[0]} is no state of the scene ({', '.join(names)})")
        counts = [counts.get(name, default) for name in names]
    elif not hasattr(counts, "__len__"):
        counts = [counts] * len(names)
    if len(counts) != len(names):
        raise InputError(f"counts: {len(counts)} numbers for {len(names)} states: {', '.join(names)}")
    return [_options.whole("counts", count, 1, 1_000_000) for count in counts]


def refuse_axes(problem) -> None:
    """Refuses a grid of states of which one is called like something else there."""
    name = problem._scene.no_axis()
    if name is not None:
        raise InputError(
            f"a state named {name} is no axis of a grid, whose Dataset has another {name}: rename it, or ask for V at points"
        )


class Value:
    """V at any state, and p = dV/dx, u, the error, interpolated from a ``result`` (a file's path, a
    Dataset or a DataTree).

    Calls take states ``x`` as an array (..., states), absolute and in the scene's units, or by name (those
    that are not named are at the equilibrium); on a finite horizon also a time ``t`` (default 0). They
    return an array of the shape (...), with p and u (..., states) and (..., controls); NaN where nothing
    is known.

    >>> v = p.value(p.map(error=1e-3))
    >>> v([0.5, 0.0]), v.p([0.5, 0.0]), v.u([0.5, 0.0])
    >>> v(theta=np.linspace(-1, 1, 11), omega=0.0)      # the usual broadcasting
    """

    def __init__(self, result):
        from ._problem import Problem

        self._file = _files.file_of(result)
        self._map = _engine.Value(self._file.path)
        #: The problem that the result is of.
        self.problem: Problem = Problem._of(self._map.scene)

    def __reduce__(self):
        return Value, (self._file,)

    def __deepcopy__(self, memo):
        return self

    def _places(self, more, x, t, named):
        """States as rows, times and the shape of what is returned; times None where V does not depend
        on them."""
        import numpy as np

        if more:
            raise TypeError("states are one array, v([0.5, -0.2]), or by name")
        if t is not None and x is None and "t" in self.problem.states:
            named, t = {**named, "t": t}, None
        rows, shape = states_of(self.problem, x, named)
        if t is None:
            return rows, None, shape
        times = numbers(t, "t")
        try:
            whole = np.broadcast_shapes(shape, times.shape)
        except ValueError:
            raise InputError(f"t of the shape {times.shape} does not fit states of the shape {shape}") from None
        n = rows.shape[-1]
        rows = np.broadcast_to(rows.reshape(*shape, n), (*whole, n)).reshape(-1, n)
        times = np.broadcast_to(times, whole).ravel()
        return np.ascontiguousarray(rows), np.ascontiguousarray(times), whole

    def _ask(self, which, more, x, t, named):
        import numpy as np

        _options.in_first_process()
        rows, times, shape = self._places(more, x, t, named)
        width = {"V": 1, "p": len(self.problem.states), "u": len(self.problem.controls)}[which]
        if times is None or not self._map.has_time or not times.any():
            # Ctrl-C is heard between parts.
            parts = [self._map.many(part)[which] for part in _parts(rows)]
            values = parts[0] if len(parts) == 1 else np.concatenate(parts or [np.zeros(0)])
        else:
            values = self._map.at(rows, times, False)[which]
        return values.reshape(shape if which == "V" else (*shape, width))[()]

    def __call__(self, x: Any = None, /, *more: Any, t: Any = None, **states: Any) -> np.ndarray:
        """V at ``x`` (and ``t``): shape (...), in units of the cost."""
        return self._ask("V", more, x, t, states)

    def p(self, x: Any = None, /, *more: Any, t: Any = None, **states: Any) -> np.ndarray:
        """p = dV/dx at ``x`` (and ``t``): shape (..., states), in units of the cost by those of the states."""
        return self._ask("p", more, x, t, states)

    def u(self, x: Any = None, /, *more: Any, t: Any = None, **states: Any) -> np.ndarray:
        """The optimal controls at ``x`` (and ``t``): shape (..., controls), in their units."""
        return self._ask("u", more, x, t, states)

    def _all(self, x, t, named):
        import numpy as np

        _options.in_first_process()
        rows, times, shape = self._places((), x, t, named)
        if times is None:
            times = np.zeros(len(rows))
        return self._map.at(rows, times, True), shape

    def error(self, x: Any = None, /, *, t: Any = None, **states: Any) -> np.ndarray:
        """Estimated error of V at ``x`` (and ``t``): shape (...), in units of the cost."""
        found, shape = self._all(x, t, states)
        return found["V_error"].reshape(shape)[()]

    def status(self, x: Any = None, /, *, t: Any = None, **states: Any) -> np.ndarray:
        """What is known at ``x`` (and ``t``), in a word: "interpolated", or why nothing is; shape (...)."""
        import numpy as np

        found, shape = self._all(x, t, states)
        words = dict(self._map.statuses())
        return np.array([words[c] for c in found["status"].tolist()], object).reshape(shape)[()]

    def at(self, points: Any = None, /, *, t: float | None = None, **states: Any) -> xr.Dataset:
        """V, p, u, their errors, the sheet and the status, as a Dataset.

        Parameters
        ----------
        points
            States, as for :meth:`Problem.solve`; or by name.
        t : float
            The time, on a finite horizon.
        """
        import numpy as np

        _options.in_first_process()
        if t is not None and points is None and "t" in self.problem.states:
            states, t = {**states, "t": t}, None
        places = Places(self.problem, points, states)
        time = 0.0 if t is None else _options.number("t", t)
        times = np.full(len(places.x), time if self._map.has_time else 0.0)
        with _files.Target(None) as target:
            self._map.write(target.path, places.x, times)
            file = target.file()
        return places.shaped(_files.dataset(file, "points"))

    def grid(self, *, counts: Any = None, t: Any = None, out: Any = None, **axes: Any) -> xr.Dataset:
        """The same on a grid, as the Dataset ``/map``.

        Parameters
        ----------
        counts : int or dict of int
            Points of each axis over the region.
        **axes
            An axis itself, by its state's name.
        t : float or array_like
            Times, on a finite horizon: a last axis.
        out : path
            The result file; without it there is none that lasts.
        """
        import numpy as np

        _options.in_first_process()
        refuse_axes(self.problem)
        names = self.problem.states
        if t is not None and "t" in names:
            axes, t = {**axes, "t": t}, None
        unknown = [name for name in axes if name not in names]
        if unknown:
            raise InputError(f"{unknown[0]} is no state of the scene ({', '.join(names)})")
        lines = []
        for name, count in zip(names, counts_of(names, counts)):
            if name in axes:
                line = np.atleast_1d(numbers(axes[name], name))
                if line.ndim != 1 or not line.size or not np.isfinite(line).all():
                    raise InputError(f"{name}: the finite values along an axis")
            else:
                low, high = self.problem.region[name]
                # As the engine has them, to the bit.
                steps = np.arange(count)
                line = low + (high - low) * steps / max(count - 1, 1)
                line[-1] = high if count > 1 else 0.5 * (low + high)
            lines.append(line)
        all_lines = list(lines)
        if self._map.has_time:
            all_lines.append(np.atleast_1d(numbers(0.0 if t is None else t, "t")))
        mesh = np.stack(np.meshgrid(*all_lines, indexing="ij"), axis=-1).reshape(-1, len(all_lines))
        x = np.ascontiguousarray(mesh[:, : len(names)])
        times = np.ascontiguousarray(mesh[:, -1]) if self._map.has_time else np.zeros(len(x))
        with _files.Target(_options.out(out)) as target:
            self._map.write(target.path, x, times, [line.tolist() for line in all_lines])
            file = target.file()
        made = _files.dataset(file, "map")
        asked = _files.said(self._file).get("map") or {}
        for name in ("error_asked", "floor", "share_unmet", "share_unknown", "share_uncertain"):
            if asked.get(name) is not None:
                made.attrs[name] = asked[name]
        # What was asked knows more than what it has answered.
        return _files._held(made, self._file if out is None else file)

    def to_c(self, path: Any = None, *, name: str = "map") -> str:
        """V and u of a map in pieces as a header of C without dependencies; also written to the file
        ``path``. What it defines begins with ``name``."""
        self._file.same()
        return _files.write(path, self._map.to_c(identifier(name)))

    def __repr__(self):
        return f"<pycostate.Value of {self.problem.title!r}, {self._file.path}>"
