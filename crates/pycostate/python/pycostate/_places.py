"""States that are given in one of many ways."""

from __future__ import annotations

from . import _files
from .errors import InputError


def identifier(name: str) -> str:
    if not (name.isascii() and name.isidentifier()):
        raise InputError(f"name = {name!r}: an identifier of C")
    return name


class Places:
    """States that were given in one of many ways, and the dimensions of what is found there."""

    def __init__(self, problem, points, named):
        import numpy as np
        import xarray as xr

        if points is not None and named:
            raise InputError("states are given as points or by name, not both")
        names = problem.states
        self._one = points is None and not named
        if hasattr(points, "to_xarray") and not isinstance(points, (xr.Dataset, xr.DataArray)):
            named = {c: ("point", np.asarray(points[c])) for c in points.columns}
        elif isinstance(points, xr.Dataset):
            named = {n: points[n] for n in names if n in points.variables}
        elif isinstance(points, xr.DataArray) and "state" in points.dims:
            named = {n: points.sel(state=n) for n in names} if "state" in points.coords else {
                n: points.isel(state=k) for k, n in enumerate(names)
            }
            named = {n: v.drop_vars("state", errors="ignore") for n, v in named.items()}
        elif points is not None:
            rows = np.asarray(points)
            if rows.dtype == object or not np.can_cast(rows.dtype, float, "same_kind"):
                raise InputError(f"points of {rows.dtype} are no states")
            rows = rows.astype(float)
            if rows.ndim == 1:
                rows = rows[None, :]
            if rows.ndim != 2 or rows.shape[1] != len(names):
                raise InputError(
                    f"points have the shape {np.shape(points)}; needed is (N, {len(names)}): {', '.join(names)}"
                )
            named = {n: ("point", rows[:, k]) for k, n in enumerate(names)}
        unknown = [n for n in named if n not in names]
        if unknown:
            raise InputError(f"{unknown[0]} is no state of the scene ({', '.join(names)})")

        arrays = {}
        for name in names:
            given = named.get(name, problem.reference[name])
            if isinstance(given, tuple):
                given = xr.DataArray(np.asarray(given[1], dtype=float), dims=given[0])
            elif not isinstance(given, xr.DataArray):
                values = np.asarray(given)
                if not np.can_cast(values.dtype, float, "same_kind"):
                    raise InputError(f"{name} of {values.dtype} is no number")
                values = values.astype(float)
                if values.ndim > 1:
                    raise InputError(
                        f"{name} has {values.ndim} dimensions: give a DataArray that names them"
                    )
                given = xr.DataArray(values, dims=(name,) * values.ndim)
                if values.ndim:
                    given = given.assign_coords({name: values})
            arrays[name] = given
        broadcast = xr.broadcast(*arrays.values())
        self.names = names
        self.arrays = dict(zip(names, broadcast))
        self._given = arrays
        self.dims = broadcast[0].dims
        self.shape = broadcast[0].shape
        self.coords = broadcast[0].coords
        columns = [np.asarray(b.transpose(*self.dims), dtype=float).ravel() for b in broadcast]
        self.x = np.ascontiguousarray(np.stack(columns, axis=-1))
        wrong = np.argwhere(~np.isfinite(self.x))
        if len(wrong):
            row, column = wrong[0]
            raise InputError(
                f"state {row} (from 0): {names[column]} = {self.x[row, column]} is no finite number"
            )

    def shaped(self, found):
        """What was found at `point`s over the dimensions that were given."""
        import xarray as xr

        if self.dims == ("point",):
            # As it is, with what else was known of the points.
            return _files._held(found.assign_coords(dict(self.coords)), _files.file_of(found))
        variables, coords = {}, {}
        for name, variable in found.variables.items():
            if name == "point":
                continue
            if variable.dims[:1] == ("point",):
                values = variable.values.reshape(self.shape + variable.shape[1:])
                variable = xr.Variable(self.dims + variable.dims[1:], values, variable.attrs)
            (coords if name in found.coords else variables)[name] = variable
        made = xr.Dataset(variables, coords, found.attrs)
        units = dict(zip(self.names, found.coords["state_units"].values)) if "state_units" in found.coords else {}
        for name in self.names:
            given = self._given[name]
            if given.ndim <= 1:
                made = made.assign_coords({name: given.variable})
            else:
                made = made.assign_coords({name: (given.dims, given.values)})
            if name in units:
                made[name].attrs["units"] = units[name]
        extra = {k: v for k, v in self.coords.items() if k not in made.coords}
        return _files._held(made.assign_coords(extra), _files.file_of(found))


def states_of(problem, x, named):
    """States (..., states) or by name as rows, and the shape (...)."""
    import numpy as np

    names = problem.states
    if x is None:
        unknown = [n for n in named if n not in names]
        if unknown:
            raise InputError(f"{unknown[0]} is no state of the scene ({', '.join(names)})")
        reference = problem.reference
        columns = [np.asarray(named.get(n, reference[n]), dtype=float) for n in names]
        x = np.stack(np.broadcast_arrays(*columns), axis=-1)
    elif named:
        raise InputError("states are given as an array or by name, not both")
    x = np.asarray(x)
    if not np.can_cast(x.dtype, float, "same_kind"):
        raise InputError(f"states of {x.dtype} are no numbers")
    if x.ndim == 0 and len(names) == 1:
        x = x[None]
    if x.ndim == 0 or x.shape[-1] != len(names):
        raise InputError(
            f"states have the shape {x.shape}; needed is (..., {len(names)}): {', '.join(names)}"
        )
    rows = np.ascontiguousarray(x.reshape(-1, len(names)), dtype=float)
    return rows, x.shape[:-1]
