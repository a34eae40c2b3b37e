"""States that are given as arrays, Datasets, tables or by name."""

from __future__ import annotations

import re
from collections.abc import Mapping

from . import _files
from .errors import InputError


def identifier(name):
    """A name that is one in C, too."""
    if not (isinstance(name, str) and re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name)):
        raise InputError(f"{name!r} is no name in C: letters, digits and _")
    return name


def numbers(values, what):
    """An array of float of what converts safely."""
    import numpy as np

    try:
        array = np.asarray(values)
        if array.dtype == object:
            # Fractions, decimals and the like are numbers, too.
            if any(value is None for value in array.flat):
                raise TypeError("None is no number")
            array = array.astype(float)
    except (TypeError, ValueError) as wrong:
        raise InputError(f"{what}: {wrong}") from None
    if array.dtype == bool or not np.can_cast(array.dtype, float, "same_kind"):
        raise InputError(f"{what}: {array.dtype} is no number")
    return np.ma.filled(np.ma.asarray(values, dtype=float), np.nan) if np.ma.isMA(values) else array.astype(float)


def by_name(problem, points):
    """States by name of what has names; None for an array."""
    import xarray as xr

    names = problem.states
    listed = ", ".join(names)
    if isinstance(points, xr.DataTree):
        points = points.to_dataset()
    if isinstance(points, Mapping) and not isinstance(points, xr.Dataset):
        return dict(points)
    if isinstance(points, xr.DataArray):
        if "state" not in points.dims:
            return None
        if "state" not in points.coords:
            if points.sizes["state"] != len(names):
                raise InputError(f"the points have {points.sizes['state']} states; needed are {listed}")
            return {n: points.isel(state=k) for k, n in enumerate(names)}
        missing = [n for n in names if n not in points.coords["state"].values]
        if missing:
            raise InputError(f"the points have no state {missing[0]}; needed are {listed}")
        parts = {n: points.sel(state=n) for n in names}
        return {n: part.drop_vars("state", errors="ignore") for n, part in parts.items()}
    if isinstance(points, xr.Dataset):
        given = {
            n: points[n]
            for n in names
            if n in points.variables and points[n].dtype.kind not in "OUS" and "state" not in points[n].dims
        }
        # A result's own states, unless it has them as coordinates.
        if "x0" in points and "state" in points.x0.dims and not all(n in points.coords and n in given for n in names):
            return by_name(problem, points.x0)
        if not given and "x" in points and "state" in points.x.dims:
            return by_name(problem, points.x)
        if not given:
            there = ", ".join(map(str, points.variables)) or "nothing"
            raise InputError(f"the Dataset names no state ({listed}); it has {there}")
        return given
    if hasattr(points, "columns") and hasattr(points, "to_numpy"):
        inner = [n for n in points.index.names if n in names and n not in points.columns]
        points = points.reset_index(inner) if inner else points
        columns = list(points.columns)
        twice = [n for n in names if columns.count(n) > 1]
        if twice:
            raise InputError(f"the table has {twice[0]} twice")
        missing = [n for n in names if n not in columns]
        others = [c for c in columns if c not in names]
        if len(missing) == len(names):
            raise InputError(f"the table has no column of a state ({listed})")
        if missing and others:
            raise InputError(f"{others[0]} is no state of the scene, and {missing[0]} has no column ({listed})")
        return {n: ("point", numbers(points[n], n)) for n in names if n in columns}
    if hasattr(points, "index") and hasattr(points, "to_numpy"):
        # A row of a table.
        labels = list(points.index)
        if any(n in labels for n in names):
            return {n: points[n] for n in names if n in labels}
    return None


class Places:
    """States that were given in one of many ways, and the dimensions of what is found there.

    ``finite``: states that are no finite numbers are refused.
    """

    def __init__(self, problem, points, named, *, finite=True):
        import numpy as np
        import xarray as xr

        if points is not None and named:
            raise InputError("states are given as points or by name, not both")
        names = problem.states
        if points is not None:
            found = by_name(problem, points)
            named = self._rows(points, names) if found is None else found
        unknown = [n for n in named if n not in names]
        if unknown:
            raise InputError(f"{unknown[0]} is no state of the scene ({', '.join(names)})")

        for given in named.values():
            for dim in given.dims if isinstance(given, xr.DataArray) else ():
                if dim not in names and dim != "point" and problem._scene.is_taken(str(dim)):
                    raise InputError(f"a dimension {dim} is the result's own: rename it")
        arrays = {}
        for name in names:
            given = named.get(name, problem.reference[name])
            if isinstance(given, tuple) and len(given) == 2 and isinstance(given[0], str):
                given = xr.DataArray(numbers(given[1], name), dims=given[0])
            elif not isinstance(given, xr.DataArray):
                values = numbers(given, name)
                if values.ndim > 1:
                    raise InputError(
                        f"{name} has {values.ndim} dimensions: give a DataArray that names them"
                    )
                given = xr.DataArray(values, dims=(name,) * values.ndim)
                if values.ndim:
                    given = given.assign_coords({name: values})
            arrays[name] = given
        try:
            broadcast = xr.broadcast(*arrays.values())
        except ValueError as wrong:
            raise InputError(f"the states do not fit together: {wrong}") from None
        self.names = names
        self._given = arrays
        self.dims = broadcast[0].dims
        self.shape = broadcast[0].shape
        self.coords = broadcast[0].coords
        columns = [
            numbers(b.transpose(*self.dims).values, n).ravel() for n, b in zip(names, broadcast)
        ]
        self.x = np.ascontiguousarray(np.stack(columns, axis=-1))
        bad = np.argwhere(~np.isfinite(self.x))
        if finite and len(bad):
            row, column = bad[0]
            raise InputError(
                f"state {row} (from 0): {names[column]} = {self.x[row, column]} is no finite number"
            )

    @staticmethod
    def _rows(points, names):
        """An array (N, states) by name."""
        rows = numbers(points, "points")
        if rows.ndim == 1:
            rows = rows[:, None] if len(names) == 1 else rows[None, :]
        if rows.ndim != 2 or rows.shape[1] != len(names):
            raise InputError(
                f"points have the shape {rows.shape}; needed is (N, {len(names)}): {', '.join(names)}"
            )
        return {n: ("point", rows[:, k]) for k, n in enumerate(names)}

    def shaped(self, found):
        """What was found at `point`s over the dimensions that were given."""
        import xarray as xr

        if self.dims == ("point",):
            # As it is, with what else was known of the points.
            added = {k: v for k, v in self.coords.items() if k == "point" or k not in found.variables}
            return _files._held(found.assign_coords(added), _files.file_of(found))
        # What is called like something of the result is told apart.
        taken = set(found.variables) | set(found.dims)
        labels = {n: f"state_{n}" if n in taken else n for n in self.names}
        dims = tuple(labels.get(d, d) for d in self.dims)
        variables, coords = {}, {}
        for name, variable in found.variables.items():
            if name == "point":
                continue
            if variable.dims[:1] == ("point",):
                values = variable.data.reshape(self.shape + variable.shape[1:])
                variable = xr.Variable(dims + variable.dims[1:], values, variable.attrs)
            (coords if name in found.coords else variables)[name] = variable
        made = xr.Dataset(variables, coords, found.attrs)
        units = dict(zip(self.names, found.coords["state_units"].values)) if "state_units" in found.coords else {}
        for name in self.names:
            given, label = self._given[name], labels[name]
            own = tuple(labels.get(d, d) for d in given.dims)
            attributes = {**given.attrs, **({"units": units[name]} if name in units else {})}
            made = made.assign_coords({label: (own, given.values, attributes)})
        extra = {
            k: v for k, v in self.coords.items() if k not in made.variables and k not in self.names
        }
        return _files._held(made.assign_coords(extra), _files.file_of(found))


def states_of(problem, x, named):
    """States (..., states) or by name as rows, and the shape (...)."""
    import numpy as np

    names = problem.states
    if x is not None and named:
        raise InputError("states are given as an array or by name, not both")
    if x is not None:
        found = by_name(problem, x)
        if found is not None:
            places = Places(problem, found, {}, finite=False)
            return places.x, places.shape
    else:
        unknown = [n for n in named if n not in names]
        if unknown:
            raise InputError(f"{unknown[0]} is no state of the scene ({', '.join(names)})")
        reference = problem.reference
        columns = [numbers(named.get(n, reference[n]), n) for n in names]
        try:
            x = np.stack(np.broadcast_arrays(*columns), axis=-1)
        except ValueError as wrong:
            raise InputError(f"the states do not fit together: {wrong}") from None
    x = numbers(x, "states")
    if x.ndim == 0 and len(names) == 1:
        x = x[None]
    if x.ndim == 0 or x.shape[-1] != len(names):
        raise InputError(
            f"states have the shape {x.shape}; needed is (..., {len(names)}): {', '.join(names)}"
        )
    rows = np.ascontiguousarray(x.reshape(-1, len(names)), dtype=float)
    return rows, x.shape[:-1]
