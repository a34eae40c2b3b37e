"""Reads a result file with xarray: u at a state, checks, and a picture (V, the boundary of the sheets, one control).

    python examples/read_result.py out/pendulum.h5 [picture.png]

The scene needs [shoot_out], [homotopy] and [map]. Exits 1 where what was read is not a value function and its law.
Needs xarray with h5netcdf or netCDF4, scipy (for interp) and matplotlib (for the picture)."""

import sys

import numpy as np
import xarray as xr

file = xr.open_datatree(sys.argv[1])  # all groups; xr.open_dataset(..., group="map") opens one
missing = [name for name in ("trajectories", "map", "points") if name not in file]
if missing:  # a map in pieces has no grid of its own: costate value FILE.h5 --grid ... --out GRID.h5 writes one
    sys.exit(f"read_result.py: {sys.argv[1]} has no {' and no '.join(missing)}: run a scene with [shoot_out], [homotopy] and [map]")
swept, grid, points = (file[name].to_dataset() for name in ("trajectories", "map", "points"))
print(f"{file.attrs['title']}: {swept.sizes['trajectory']} trajectories, map {dict(grid['V'].sizes)}")

# The map's axes are named like the states; one with a single node cannot be interpolated along.
axes = [s for s in grid["state"].values if grid.sizes[s] > 1]
grid = grid.isel({s: 0 for s in grid["state"].values if s not in axes})


def law(x):
    """u at a state. It jumps between sheets: nodes of other sheets are left out, and a cell with one gives NaN."""
    where = {s: x.sel(state=s) for s in axes}
    sheet = int(grid["sheet"].sel(where, method="nearest"))
    return grid["u"].where(grid["sheet"] == sheet).interp(where).values


u = np.array([law(x) for x in points["x0"]])
known = np.isfinite(u - points["u"].values).all(axis=1)
i = np.flatnonzero(known)[known.sum() // 3]
print("x", points["x0"][i].values, "u of the map", u[i], "u solved for there", points["u"][i].values)

# What must hold, up to the errors of differences (hence the 2 %): H = 0 and dV = p . dx along trajectories, p = dV/dx
# on the map, and the map's u at the states that were solved one by one.
t, x, p, V = (swept[name].values for name in "txpV")  # (trajectory, sample), x and p with a third axis: state
dV, pdx = np.diff(V), ((p[:, 1:] + p[:, :-1]) / 2 * np.diff(x, axis=1)).sum(axis=2)
errors = {"|H| / running cost": np.nanmax(abs(swept["H"])) / np.nanmedian(-dV / np.diff(t)),
          "dV - p.dx": np.nanmedian(abs(pdx / dV - 1))}
for s in axes:
    slope, costate = grid["V"].diff(s) / grid[s].diff(s), grid["p"].sel(state=s).rolling({s: 2}).mean()
    errors[f"dV/d{s} - p"] = float(abs(slope - costate).median() / abs(slope).median())
errors["u of map - points"] = np.median(abs(u - points["u"].values)[known]) / float(abs(grid["u"]).max())
print(*(f"{name:20} {error:.1e}" for name, error in errors.items()), sep="\n")
if not all(error < 0.02 for error in errors.values()):  # NaN fails as well
    sys.exit("read_result.py: an error is above 2 %")

if len(sys.argv) > 2:
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.2), dpi=110, constrained_layout=True)
    plane = grid["V"].isel({s: grid.sizes[s] // 2 for s in axes[2:]}, drop=True)  # further states: the map's middle
    levels = np.geomspace(0.02, 0.9, 8) * float(plane.max())
    colors = [tuple(c) for c in plt.cm.viridis(np.linspace(0, 0.8, 8))]
    plt.clabel(plane.plot.contour(ax=left, x=axes[0], levels=levels, colors=colors), fontsize=7, fmt="%.3g")
    if "equal_cost" in file and len(axes) == 2:
        edge = file["equal_cost"].to_dataset().sortby("place")
        for line in set(edge["line"].values) - {-1}:
            left.plot(*edge["x"][edge["line"] == line].sel(state=axes).values.T, "k", linewidth=2.5)
    slowest = swept.set_coords("t").isel(trajectory=np.nanargmin(t[:, 0]))
    if len(axes) == swept.sizes["state"]:  # a swept trajectory goes on, back in time, where another sheet is cheaper
        best = grid["V"].interp({s: slowest["x"].sel(state=s) for s in axes})
        slowest = slowest.isel(sample=(slowest["V"] < 1.02 * best).values)
    left.plot(*slowest["x"].sel(state=axes[:2]).values.T, color="C1")
    slowest["u"].plot.line(ax=right, x="t")
    left.set_title("V, the boundary of the sheets (black), a trajectory")
    right.set_title("the trajectory's control")
    figure.savefig(sys.argv[2])
