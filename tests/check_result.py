#!/usr/bin/env python3
"""Checks a result file as its readers see it: xarray with both engines and no keyword, h5py, ncdump
and h5dump.

    python tests/check_result.py FILE

Prints one line of JSON and exits 0 when everything holds; otherwise names what does not and exits 1.
Needs h5py, xarray, netCDF4, h5netcdf and numpy, and the commands ncdump and h5dump.
"""

import json
import shutil
import subprocess
import sys

import h5py
import numpy as np
import xarray as xr

ENGINES = ("netcdf4", "h5netcdf")
GROUP = "trajectories"

ROOT_TEXT = (
    "title", "scenario", "costate_version", "git_revision", "command", "created",
    "backend", "adapter", "precision", "method",
)
ROOT_NUMBER = ("rtol", "atol", "wall_seconds")

ROW = ("trajectory",)
GRID = ("trajectory", "sample")
VARIABLES = {
    "t": GRID, "V": GRID, "H": GRID,
    "x": (*GRID, "state"), "p": (*GRID, "state"),
    "hamiltonian_drift": ROW,
    "status": ROW, "sheet": ROW, "steps": ROW, "rejected": ROW,
}
INTEGERS = ("status", "sheet", "steps", "rejected")
# Present together, or both absent: the dimension and the variable along it.
OPTIONAL = {"control": "u", "disturbance": "w"}
TEXTS = {"costate_units": "state"}


class Failure(Exception):
    """What a result file should be and is not."""


def check(condition, message):
    if not condition:
        raise Failure(message)


def equal(a, b):
    a, b = np.asarray(a), np.asarray(b)
    if a.shape != b.shape or a.dtype != b.dtype:
        return False
    return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


def expected_variables(names):
    """Dimensions of every variable that is not a coordinate, given the dimensions' names."""
    variables, texts = dict(VARIABLES), dict(TEXTS)
    axes = ["state"]
    for dimension, variable in OPTIONAL.items():
        if dimension in names:
            variables[variable] = (*GRID, dimension)
            axes.append(dimension)
    for axis in axes:
        texts[f"{axis}_units"] = axis
        texts[f"{axis}_long_name"] = axis
    return variables, texts


def check_root(attributes, reader):
    for name in ROOT_TEXT:
        check(name in attributes, f"{reader}: no root attribute {name}")
        check(isinstance(attributes[name], str), f"{reader}: {name} is not a text")
    for name in ROOT_NUMBER:
        check(name in attributes, f"{reader}: no root attribute {name}")
        number = np.asarray(attributes[name])
        check(number.dtype == np.float64 and number.size == 1, f"{reader}: {name} is not one f64")
    check(attributes["scenario"] != "", f"{reader}: the scenario is empty")


def check_texts(values, expected_length, what):
    values = list(values)
    check(len(values) == expected_length, f"{what}: {len(values)} texts, not {expected_length}")
    check(all(isinstance(value, str) for value in values), f"{what}: not all texts are str")


def check_flags(attributes, values, what):
    check("flag_values" in attributes and "flag_meanings" in attributes, f"{what}: no flags")
    flags = np.atleast_1d(attributes["flag_values"])
    meanings = str(attributes["flag_meanings"]).split()
    check(flags.dtype == np.int32, f"{what}: flag_values are {flags.dtype}")
    check(len(flags) > 0, f"{what}: no flag_values")
    check(len(flags) == len(meanings), f"{what}: {len(flags)} flags, {len(meanings)} meanings")
    check(len(set(flags.tolist())) == len(flags), f"{what}: a flag value twice")
    unknown = set(np.unique(values).tolist()) - set(flags.tolist())
    check(not unknown, f"{what}: values without a flag: {sorted(unknown)}")


def check_dataset(data, engine):
    """The group as xarray opens it."""
    where = f"{engine}: "
    required = ("trajectory", "sample", "state")
    check(all(name in data.sizes for name in required), f"{where}dimensions {dict(data.sizes)}")
    check(set(data.sizes) <= {*required, *OPTIONAL}, f"{where}dimensions {dict(data.sizes)}")
    check(set(data.coords) == set(data.sizes), f"{where}coordinates {sorted(data.coords)}")
    variables, texts = expected_variables(data.sizes)
    check(set(data.data_vars) == {*variables, *texts}, f"{where}variables {sorted(data.data_vars)}")

    for name in data.variables:
        attributes = data[name].attrs
        for key in ("units", "long_name"):
            check(isinstance(attributes.get(key), str), f"{where}{name} has no {key}")
            check(attributes[key] != "", f"{where}{name} has an empty {key}")
    for name, dimensions in variables.items():
        what = where + name
        check(data[name].dims == dimensions, f"{what} has dimensions {data[name].dims}")
        dtype = np.dtype("int32" if name in INTEGERS else "float64")
        check(data[name].dtype == dtype, f"{what} is {data[name].dtype}")
        if dtype.kind == "f":
            fill = np.asarray(data[name].encoding.get("_FillValue"), dtype="float64")
            check(fill.size == 1 and np.isnan(fill).all(), f"{what}: the fill value is {fill}")
    for name, dimension in texts.items():
        check(data[name].dims == (dimension,), f"{where}{name} has dimensions {data[name].dims}")
        check_texts(data[name].values, data.sizes[dimension], where + name)
    for name in ("trajectory", "sample"):
        index = data[name]
        check(index.dtype == np.int64, f"{where}{name} is {index.dtype}")
        check(equal(index.values, np.arange(data.sizes[name])), f"{where}{name} does not count")
    for name in set(data.sizes) & {"state", *OPTIONAL}:
        check_texts(data[name].values, data.sizes[name], where + name)
        check(len(set(data[name].values)) == data.sizes[name], f"{where}{name}: a name twice")
        first = str(data[name].values[0])
        check(data.sel({name: first}).sizes.get(name) is None, f"{where}cannot select {name}")
    check_flags(data["status"].attrs, data["status"].values, where + "status")
    check(data.encoding.get("unlimited_dims") == {"trajectory"}, f"{where}the unlimited dimensions")


def check_numbers(data):
    """What holds for any trajectories, whatever the system."""
    t = data["t"].values
    steps = np.diff(t, axis=1)
    check(np.all((steps > 0) | np.isnan(steps)), "t does not ascend along a trajectory")
    check(not np.isinf(t).any(), "t is infinite somewhere")
    for name in ("steps", "rejected"):
        check(np.all(data[name].values >= 0), f"{name} is negative somewhere")
    drift = data["hamiltonian_drift"].values
    check(np.all((drift >= 0) | np.isnan(drift)), "hamiltonian_drift is negative somewhere")
    missing = np.isnan(t)
    for name in ("x", "p", "V", "H"):
        values = data[name].values
        present = ~np.isnan(values)
        if values.ndim > t.ndim:
            present = present.any(axis=2)
        check(not (present & missing).any(), f"{name} has values where t has none")


def check_h5py(path, data):
    """The file as HDF5, against what xarray read."""
    with h5py.File(path, "r") as file:
        check_root(dict(file.attrs), "h5py")
        group = file[GROUP]
        check(set(group) == set(data.variables), f"h5py: objects {sorted(group)}")
        for name, variable in data.variables.items():
            dataset = group[name]
            if name in data.sizes:
                check(dataset.is_scale, f"h5py: {name} is not a dimension scale")
            else:
                for axis, dimension in enumerate(variable.dims):
                    scales = list(dataset.dims[axis].values())
                    names = [scale.name for scale in scales]
                    check(names == [f"/{GROUP}/{dimension}"], f"h5py: {name} has scales {names}")
            raw = dataset[()]
            if h5py.check_string_dtype(dataset.dtype):
                texts = [text.decode("utf-8") for text in np.atleast_1d(raw)]
                check(texts == [str(v) for v in variable.values], f"h5py: {name} differs")
            else:
                check(equal(raw, variable.values), f"h5py: {name} differs")
            if "trajectory" in variable.dims:
                check(dataset.maxshape[0] is None, f"h5py: {name} cannot grow")
            if dataset.dtype.kind == "f":
                check(np.isnan(dataset.fillvalue), f"h5py: {name} is filled with a number")
                check("_FillValue" in dataset.attrs, f"h5py: {name} has no _FillValue")


def header(command, path):
    """What a command-line reader says about the file without its numbers."""
    check(shutil.which(command[0]), f"{command[0]} is not installed")
    done = subprocess.run([*command, path], capture_output=True, text=True)
    check(done.returncode == 0 and not done.stderr, f"{command[0]}: {done.stderr}")
    return done.stdout


def check_headers(path, data):
    text = header(["ncdump", "-h"], path)
    check(f"group: {GROUP}" in text, "ncdump: no group")
    check("phony_dim" not in text, "ncdump: a dimension without a name")
    check("trajectory = UNLIMITED" in text, "ncdump: trajectory is limited")
    types = {"f": "double", "i": "int"}
    for name, variable in data.data_vars.items():
        kind = types.get(variable.dtype.kind, "string")
        declared = f"{kind} {name}({', '.join(variable.dims)})"
        check(declared in text, f"ncdump: no {declared}")
    text = header(["h5dump", "-H"], path)
    for name in data.variables:
        check(f'DATASET "{name}"' in text, f"h5dump: no {name}")


def summary(data):
    counts = np.unique(data["status"].values, return_counts=True)
    return {
        "dimensions": {name: int(size) for name, size in data.sizes.items()},
        "status": {str(code): int(count) for code, count in zip(*counts)},
        "missing": int(np.isnan(data["V"].values).sum()),
        "engines": list(ENGINES),
    }


def main(path):
    opened = {}
    for engine in ENGINES:
        with xr.open_dataset(path, engine=engine) as root:
            check_root(root.attrs, engine)
            check(not root.sizes, f"{engine}: the root has dimensions {dict(root.sizes)}")
        with xr.open_dataset(path, group=GROUP, engine=engine) as data:
            opened[engine] = data.load()
        check_dataset(opened[engine], engine)
    with xr.open_dataset(path, group=GROUP) as data:
        check(set(data.sizes) == set(opened[ENGINES[0]].sizes), "xarray without an engine differs")
    first, second = (opened[engine] for engine in ENGINES)
    check(first.identical(second), "the two engines read different data sets")
    check_numbers(first)
    check_h5py(path, first)
    check_headers(path, first)
    print(json.dumps(summary(first)))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    try:
        main(sys.argv[1])
    except (Failure, OSError, KeyError, ValueError) as failure:
        sys.exit(f"{sys.argv[1]}: {type(failure).__name__}: {failure}")
