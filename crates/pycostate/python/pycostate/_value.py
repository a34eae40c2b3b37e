"""V at any state."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from . import _engine, _files
from ._places import Places, identifier, states_of
from .errors import InputError

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr

    from ._problem import Problem


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

    def _ask(self, which, x, t, named):
        import numpy as np

        rows, shape = states_of(self.problem, x, named)
        if t is None or (np.ndim(t) == 0 and t == 0):
            found = self._map.many(rows)
        else:
            times = np.ascontiguousarray(np.broadcast_to(np.asarray(t, float), shape)).ravel()
            found = self._map.at(rows, times, False)
        values = found[which]
        return values.reshape(shape + (-1,) if which in "pu" else shape)[()]

    def __call__(self, x=None, /, *, t=None, **states) -> np.ndarray:
        """V at ``x`` (and ``t``): shape (...), in units of the cost."""
        return self._ask("V", x, t, states)

    def p(self, x=None, /, *, t=None, **states) -> np.ndarray:
        """p = dV/dx at ``x`` (and ``t``): shape (..., states), in units of the cost by those of the states."""
        return self._ask("p", x, t, states)

    def u(self, x=None, /, *, t=None, **states) -> np.ndarray:
        """The optimal controls at ``x`` (and ``t``): shape (..., controls), in their units."""
        return self._ask("u", x, t, states)

    def _all(self, x, t, named):
        import numpy as np

        rows, shape = states_of(self.problem, x, named)
        times = np.ascontiguousarray(
            np.broadcast_to(np.asarray(0.0 if t is None else t, float), shape)
        ).ravel()
        return self._map.at(rows, times, True), shape

    def error(self, x=None, /, *, t=None, **states) -> np.ndarray:
        """Estimated error of V at ``x`` (and ``t``): shape (...), in units of the cost."""
        found, shape = self._all(x, t, states)
        return found["V_error"].reshape(shape)[()]

    def status(self, x=None, /, *, t=None, **states) -> np.ndarray:
        """What is known at ``x`` (and ``t``), in a word: "interpolated", or why nothing is; shape (...)."""
        import numpy as np

        found, shape = self._all(x, t, states)
        words = dict(self._map.statuses())
        return np.array([words[c] for c in found["status"].tolist()], object).reshape(shape)[()]

    def at(self, points=None, /, *, t=None, **states) -> xr.Dataset:
        """V, p, u, their errors, the sheet and the status, as a Dataset.

        Parameters
        ----------
        points
            States, as for :meth:`Problem.solve`; or by name.
        t : float
            The time, on a finite horizon.
        """
        import numpy as np

        places = Places(self.problem, points, states)
        times = np.full(len(places.x), 0.0 if t is None else float(t))
        with _files.Target(None) as target:
            self._map.write(target.path, places.x, times)
            file = target.file()
        return places.shaped(_files.dataset(file, "points"))

    def grid(self, *, counts=None, t=None, out=None, **axes) -> xr.Dataset:
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

        names = self.problem.states
        default = {1: 401, 2: 101, 3: 41, 4: 15}.get(len(names), 5)
        lines = []
        for name in names:
            count = counts.get(name, default) if isinstance(counts, Mapping) else counts or default
            given = axes.pop(name, None)
            line = np.linspace(*self.problem.region[name], int(count)) if given is None else given
            lines.append(np.atleast_1d(np.asarray(line, dtype=float)))
        if axes:
            raise InputError(f"{next(iter(axes))} is no state of the scene ({', '.join(names)})")
        all_lines = list(lines)
        if self._map.has_time:
            all_lines.append(np.atleast_1d(np.asarray(0.0 if t is None else t, dtype=float)))
        mesh = np.stack(np.meshgrid(*all_lines, indexing="ij"), axis=-1).reshape(-1, len(all_lines))
        x = np.ascontiguousarray(mesh[:, : len(names)])
        times = np.ascontiguousarray(mesh[:, -1]) if self._map.has_time else np.zeros(len(x))
        with _files.Target(out) as target:
            self._map.write(target.path, x, times, [line.tolist() for line in all_lines])
            file = target.file()
        made = _files.dataset(file, "map")
        # What was asked knows more than what it has answered.
        return _files._held(made, self._file if out is None else file)

    def to_c(self, path=None, *, name="map") -> str:
        """V and u of a map in pieces as a header of C without dependencies; also written to the file
        ``path``. What it defines begins with ``name``."""
        text = self._map.to_c(identifier(name))
        if path is not None:
            Path(path).write_text(text, encoding="utf-8")
        return text

    def __repr__(self):
        return f"<pycostate.Value of {self.problem.title!r}, {self._file.path}>"
