#!/usr/bin/env python3
"""Checks /speed_error and /host_share as xarray opens them with both engines and no keyword, and against the summary.

    python tests/check_bench.py FILE SUMMARY.json

Exits 0 when everything holds. The picture is the file beside it with the suffix .svg. Needs xarray, netCDF4, h5netcdf
and numpy.
"""

import json
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import xarray as xr

ENGINES = ("netcdf4", "h5netcdf")
TEXTS = ("backend", "adapter", "precision", "method")
INTEGERS = ("passes", "failed", "reference_failed", "pareto")
STATUSES = ("reached", "left_region", "guard", "step_floor", "step_limit", "not_finite")
NUMBERS = (
    "rtol", "atol", "step", "seconds_median", "seconds_min", "seconds_max", "trajectories_per_second",
    "kernel_seconds_median", "kernel_seconds_min", "kernel_seconds_max", "kernel_trajectories_per_second",
    "compile_seconds", "first_seconds", "steps_mean", "rejected_mean", "e_V_median", "e_V_p99", "e_V_worst",
    "e_p_median", "e_p_p99", "e_p_worst", "e_H_median", "e_H_p99", "e_H_worst", "compared", "flops", "peak", "peak_share", "lane_occupancy",
)
ROOT = ("title", "scenario", "costate_version", "git_revision", "command", "created", "backend", "adapter", "precision",
        "method", "rtol", "atol", "wall_seconds", "machine")


def check(condition, message):
    if not condition:
        sys.exit(message)


def check_columns(d, where):
    wanted = TEXTS + INTEGERS + NUMBERS + tuple(f"status_{s}" for s in STATUSES)
    check(set(wanted) == set(d.data_vars), f"{where}: variables differ by {set(wanted) ^ set(d.data_vars)}")
    for name in wanted:
        check(d[name].dims == ("row",), f"{where}: {name} has dimensions {d[name].dims}")
        check(d[name].attrs.get("units") and d[name].attrs.get("long_name"), f"{where}: {name} lacks units or long_name")
        if name in NUMBERS:
            check(d[name].dtype == "float64", f"{where}: {name} is {d[name].dtype}")
        elif name in TEXTS:
            check(all(str(t) for t in d[name].values), f"{where}: {name} has an empty entry")
        else:
            check(d[name].dtype == "int32", f"{where}: {name} is {d[name].dtype}")
    check("row" in d.coords, f"{where}: row has no coordinate")


def check_numbers(d):
    check((d.seconds_min <= d.seconds_median).all() and (d.seconds_median <= d.seconds_max).all(), "order of seconds")
    check((d.seconds_min > 0).all() and (d.passes >= 1).all(), "every row was timed")
    known = d.kernel_seconds_median.notnull()
    check(known[d.backend == "cpu"].all(), "the CPU knows its kernels' time")
    check((d.kernel_seconds_min[known] <= d.seconds_max[known]).all(), "a kernel takes no longer than the whole")
    rate = d.attrs["trajectories"] / d.seconds_median
    check(np.allclose(rate, d.trajectories_per_second), "trajectories per second")
    for e in ("e_V", "e_p", "e_H"):
        a, b, c = (d[f"{e}_{q}"] for q in ("median", "p99", "worst"))
        check((a <= b).all() and (b <= c).all() and c.notnull().all(), f"order of {e}")
    total = sum(d[f"status_{s}"] for s in STATUSES)
    check((total == d.attrs["trajectories"]).all(), "every trajectory has a status")
    fixed = d.method == "rk4"
    check((d.step.notnull() == fixed).all() and (d.rtol.notnull() == ~fixed).all(), "steps and tolerances")
    check((d.peak > 0).all(), "the devices' arithmetic rates")
    # A share above 1 would be a wrong count or a wrong peak; methods without a count have none.
    share = d.peak_share.where(known)
    check(share.sel(row=(d.method == "tsit5") & known).notnull().all() and not (share > 1).any(), "shares of the peak")
    # Finer tolerances are better until the precision's end: tsit5 in f64 over four decades.
    series = d.where((d.backend == "cpu") & (d.precision == "f64") & (d.method == "tsit5"), drop=True).sortby("rtol")
    check(series.sizes["row"] == 3 and (np.diff(series.e_V_worst) > 0).all(), "errors follow the tolerance")
    # The front by its definition.
    able = (d.failed == 0) & (d.compared >= 0.95) & (d.e_V_worst <= 0.1)
    t, e = d.seconds_median.values, d.e_V_worst.values
    for k in range(d.sizes["row"]):
        beaten = any(able[j] and t[j] <= t[k] and e[j] <= e[k] and (t[j], e[j]) != (t[k], e[k]) for j in range(len(t)))
        check(bool(d.pareto[k]) == (bool(able[k]) and not beaten), f"row {k}: pareto is {int(d.pareto[k])}")
    check(d.pareto.any(), "there is a front")


def check_summary(d, summary):
    rows = summary["rows"]
    check(len(rows) == d.sizes["row"], "the summary has as many rows")
    for k, row in enumerate(rows):
        one = d.isel(row=k)
        for name in TEXTS:
            check(str(one[name].values) == row[name], f"row {k}: {name}")
        check(float(one.e_V_worst) == row["errors"]["e_V"]["worst"], f"row {k}: e_V")
        check(float(one.seconds_median) == row["seconds"]["median"], f"row {k}: seconds")
    for best in summary["recommended"]:
        good = d.where((d.e_V_worst <= best["error"]) & (d.failed == 0) & (d.compared >= 0.95), drop=True)
        check((best["variant"] is None) == (good.sizes["row"] == 0), f"recommended for {best['error']}")
        if best["variant"]:
            least = float(good.seconds_median.min())
            near = good.where(good.seconds_median <= 1.1 * least, drop=True)
            check(best["variant"]["seconds"]["median"] <= 1.1 * least, "one of the fastest is recommended")
            check(float(near.e_V_worst.min()) == best["variant"]["errors"]["e_V"]["worst"], "the best of them is")


def check_picture(path):
    root = ET.parse(path).getroot()
    check(root.tag.endswith("svg") and int(root.get("width")) >= 800, "the picture is an SVG of 800 pixels or more")
    words = " ".join("".join(t.itertext()).strip() for t in root.iter() if t.tag.endswith("text"))
    for word in ("trajectories a second", "error of V", "Pareto", "tsit5", "f64"):
        check(word in words, f"the picture does not say {word}: {words}")


def main(path, summary):
    for engine in ENGINES:
        root = xr.open_dataset(path, engine=engine)
        check(all(name in root.attrs for name in ROOT), f"{engine}: root attributes {sorted(root.attrs)}")
        d = xr.open_dataset(path, group="speed_error", engine=engine)
        check_columns(d, engine)
        check_numbers(d)
        check_summary(d, json.loads(Path(summary).read_text()))
        share = xr.open_dataset(path, group="host_share", engine=engine)
        check((share.trajectories == 60).all() and share.sizes["row"] >= 2, "host_share: rows")
        check(((share.host_share > 0) & (share.host_share < 1)).all(), "host_share: shares")
        check((share.kernel_seconds <= share.wall_seconds).all(), "host_share: times")
    check_picture(Path(path).with_suffix(".svg"))
    print("ok")


main(sys.argv[1], sys.argv[2])
