#!/usr/bin/env python3
"""Checks a virtual whole (`costate merge --virtual`) against a copying merge of the same parts, as h5py and
xarray read both.

    python tests/check_virtual.py COPY.h5 VIRTUAL.h5

Rows of the virtual file are put into the order in which states were given; then every number of every group
has to be the same, to the bit. Rows of parts that are gone have to be unknown. Prints how many rows of /points
these are and exits 0 when everything holds; otherwise names what does not and exits 1.
Needs h5py, numpy and xarray with netCDF4 and h5netcdf.
"""

import sys
from pathlib import Path

import h5py
import numpy as np
import xarray as xr

ENGINES = ("netcdf4", "h5netcdf")
#: The dimension of each group's rows, the column of /shard_files with their number in each part, and what is
#: stored in the virtual file itself.
ROWS = {
    "points": ("point", "points", {"given", "sheet", "lifted_sheet"}),
    "points_sheets": ("entry", "entries", {"point", "sheet", "lifted_sheet"}),
    "trajectories": ("trajectory", "trajectories", {"given", "sheet"}),
}
PLUMBING = {"REFERENCE_LIST", "DIMENSION_LIST"}
#: Where a part is gone; 0 where nothing is named.
ABSENT = {"status": "not_merged"}


class Failure(Exception):
    """What a virtual file should be and is not."""


def check(condition, message):
    if not condition:
        raise Failure(message)


def same(a, b):
    if a.shape != b.shape or a.dtype != b.dtype:
        return False
    return a.tobytes() == b.tobytes() if a.dtype.kind in "fi" else bool(np.all(a == b))


def attributes(item):
    return {name: value for name, value in item.attrs.items() if name not in PLUMBING}


def orders(virtual):
    """Of each group its rows in the order in which states were given."""
    given = virtual["points/given"][()]
    check(same(np.sort(given), np.arange(len(given), dtype=given.dtype)), "/points/given is no order")
    found = {"points": np.argsort(given)}
    if "points_sheets" in virtual:
        found["points_sheets"] = np.argsort(given[virtual["points_sheets/point"][()]], kind="stable")
    if "trajectories" in virtual:
        found["trajectories"] = np.argsort(virtual["trajectories/given"][()])
    return found


def gone(virtual, folder, column, rows):
    """Which rows lie in parts that are not there."""
    files = virtual["shard_files"]
    here = [(folder / name).exists() for name in files["file"].asstr()[()]]
    known = np.repeat(here, files[column][()])
    check(len(known) <= rows, f"/shard_files/{column} are more than there are")
    return ~np.concatenate([known, np.zeros(rows - len(known), bool)])


def absent_code(dataset):
    meanings = dataset.attrs.get("flag_meanings", "").split()
    name = ABSENT.get(dataset.name.rsplit("/", 1)[-1])
    return dataset.attrs["flag_values"][meanings.index(name)] if name in meanings else 0


def rows_are(copy, virtual, name, order, missing):
    dimension, _, own = ROWS[name]
    given = virtual["points/given"][()]
    for variable, dataset in virtual[name].items():
        where = f"/{name}/{variable}"
        numbers = dataset[()]
        if variable == dimension:
            check(same(numbers, np.arange(len(numbers), dtype=numbers.dtype)), where)
            continue
        is_row = not dataset.is_scale and dataset.dims[0][0].name.endswith(f"/{dimension}")
        if not is_row:
            check(same(numbers, copy[name][variable][()]), where)
            continue
        check(dataset.is_virtual != (variable in own), f"{where}: whether it is virtual")
        if variable == "given":
            continue
        if name == "points_sheets" and variable == "point":
            numbers = given[numbers]
        expected = copy[name][variable][()]
        numbers, lost = numbers[order], missing[order]
        check(numbers.dtype == expected.dtype and numbers.shape == expected.shape, f"{where}: {expected.shape}")
        check(same(numbers[~lost], expected[~lost]), where)
        if variable in own:
            continue
        if numbers.dtype.kind == "f":
            check(np.all(np.isnan(numbers[lost])), f"{where} of parts that are gone")
        else:
            check(np.all(numbers[lost] == absent_code(dataset)), f"{where} of parts that are gone")
        mine, theirs = attributes(dataset), attributes(copy[name][variable])
        if "flag_meanings" not in mine:
            check(str(mine) == str(theirs), f"{where}: {mine} and {theirs}")


def main(copy_path, virtual_path):
    lost = 0
    with h5py.File(copy_path) as copy, h5py.File(virtual_path) as virtual:
        check(virtual.attrs["virtual"] == 1 and "virtual" not in copy.attrs, "the attribute `virtual`")
        check(set(virtual) - {"shard_files"} == set(copy), f"groups {set(virtual)}, {set(copy)}")
        order = orders(virtual)
        for name in copy:
            if name not in ROWS:
                for variable, dataset in virtual[name].items():
                    check(same(dataset[()], copy[name][variable][()]), f"/{name}/{variable}")
                    mine, theirs = attributes(dataset), attributes(copy[name][variable])
                    check(str(mine) == str(theirs), f"/{name}/{variable}: {mine} and {theirs}")
                continue
            check(set(virtual[name]) - {"given"} == set(copy[name]), f"variables of /{name}")
            rows = len(virtual[name][ROWS[name][0]])
            missing = gone(virtual, Path(virtual_path).parent, ROWS[name][1], rows)
            lost += int(missing.sum()) if name == "points" else 0
            rows_are(copy, virtual, name, order[name], missing)
        v = virtual["points/V"][()]
    for engine in ENGINES:
        with xr.open_dataset(virtual_path, group="points", engine=engine) as read:
            check(same(read["V"].values, v), f"/points/V by {engine}")
    print(lost)


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except Failure as failure:
        sys.exit(str(failure))
