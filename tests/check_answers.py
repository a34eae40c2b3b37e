#!/usr/bin/env python3
"""Checks the groups of values at chosen states as xarray opens them with both engines and no keyword.

    python tests/check_answers.py FILE

FILE is the result of the pendulum scenario with a [homotopy] slice and a [map]. Exits 0 when everything holds.
Needs xarray, netCDF4, h5netcdf and numpy.
"""

import sys

import numpy as np
import xarray as xr

ENGINES = ("netcdf4", "h5netcdf")
EXPECTED = {
    "points": {
        "x0": ("point", "state"), "V": ("point",), "p": ("point", "state"), "u": ("point", "control"),
        "sheet": ("point",), "lifted_sheet": ("point",), "winding": ("point", "state"), "status": ("point",), "iterations": ("point",), "residual": ("point",),
        "H": ("point",), "sheets": ("point",), "furthest": ("point", "state"),
    },
    "points_sheets": {
        "point": ("entry",), "V": ("entry",), "p": ("entry", "state"), "u": ("entry", "control"),
        "sheet": ("entry",), "lifted_sheet": ("entry",), "winding": ("entry", "state"), "H": ("entry",), "residual": ("entry",),
    },
    "map": {
        "V": ("theta", "omega"), "p": ("theta", "omega", "state"), "u": ("theta", "omega", "control"),
        "sheet": ("theta", "omega"), "lifted_sheet": ("theta", "omega"), "winding": ("theta", "omega", "state"),
        "status": ("theta", "omega"),
    },
    "equal_cost": {
        "x": ("vertex", "state"), "V": ("vertex",), "difference": ("vertex",), "sheet": ("vertex", "side"),
        "p": ("vertex", "side", "state"), "u": ("vertex", "side", "control"), "jump": ("vertex", "control"),
        "line": ("vertex",), "place": ("vertex",),
    },
}
INTEGERS = {"sheet", "lifted_sheet", "status", "iterations", "sheets", "point", "winding", "line", "place"}


def check(condition, message):
    if not condition:
        sys.exit(message)


def check_group(data, group, where):
    for name, dimensions in EXPECTED[group].items():
        check(name in data.data_vars, f"{where}: no {name}")
        check(data[name].dims == dimensions, f"{where}: {name} has dimensions {data[name].dims}")
        check(data[name].dtype == ("int32" if name in INTEGERS else "float64"), f"{where}: {name} is {data[name].dtype}")
    for name in data.variables:
        for key in ("units", "long_name"):
            check(data[name].attrs.get(key), f"{where}: {name} has no {key}")
    for name in set(data.sizes):
        check(name in data.coords, f"{where}: {name} has no coordinate")
    check(list(data["state"].values) == ["theta", "omega"], f"{where}: states {data['state'].values}")


def check_numbers(groups):
    points, sheets, grid, edge = (groups[g] for g in ("points", "points_sheets", "map", "equal_cost"))
    check((points.status == 0).all() and points.V.notnull().all(), "points: all are solved")
    check("converged" in points.status.attrs["flag_meanings"].split(), "points: statuses have meanings")
    # The lowest of a point's sheets is the point's value.
    lowest = sheets.V.groupby(sheets.point).min()
    check(np.array_equal(lowest.values, points.V.values), "points_sheets: the lowest sheet is not the value")
    check(points.sheets.sum() == sheets.sizes["entry"], "points: the number of sheets")
    # NaN exactly where there is no sheet; V up to the limit.
    known = grid.V.notnull()
    check(((grid.sheet >= 0) == known).all() and (grid.p.notnull().all("state") == known).all(), "map: NaN and sheet")
    check(known.any() and not known.all() and (grid.V.max() <= 185), "map: up to V = 185")
    # At rest where it is to rest.
    at_rest = grid.V.sel(theta=-1.5, omega=0, method="nearest")
    check(at_rest < 0.1 * grid.V.median(), "map: V is small near the equilibrium")
    check((edge.difference <= 1e-6).all(), "equal_cost: the costs differ")
    jump = edge.u.isel(side=1) - edge.u.isel(side=0)
    check(np.array_equal(jump.values, edge.jump.values) and (abs(edge.jump) > 1).all(), "equal_cost: the jump")


def main(path):
    for engine in ENGINES:
        groups = {group: xr.open_dataset(path, group=group, engine=engine) for group in EXPECTED}
        for group, data in groups.items():
            check_group(data, group, f"{engine}, {group}")
        check_numbers(groups)
    print("ok")


main(sys.argv[1])
