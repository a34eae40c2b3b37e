"""Draws the sweep of a scene with two states: trajectories, fronts of equal cost, colour by cost.

    python examples/plot_sweep.py out/pendulum.h5 docs/pendulum.png

Needs xarray, h5netcdf (or netCDF4) and matplotlib.
"""

import sys

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.collections import LineCollection

source, target = sys.argv[1:3]
data = xr.open_dataset(source, group="trajectories")
title = xr.open_dataset(source).attrs["title"]
a, b = data["state"].values[:2]
x, y, V = (data["x"].sel(state=a).values, data["x"].sel(state=b).values, data["V"].values)

figure, axes = plt.subplots(figsize=(7.5, 5), dpi=110, constrained_layout=True)
norm = plt.Normalize(0, np.nanmax(V))
lines = np.stack([x, y], axis=2)
for path, value in zip(lines, V):
    pieces = np.stack([path[:-1], path[1:]], axis=1)
    axes.add_collection(LineCollection(pieces, array=value[:-1], norm=norm, cmap="viridis", linewidths=0.6))

# A front is one sample index; its points are put in order round the equilibrium by where they start.
order = np.argsort(np.arctan2(y[:, -1] - y[:, -1].mean(), x[:, -1] - x[:, -1].mean()))
order = np.append(order, order[0])
for sample in np.linspace(0, V.shape[1] - 1, 7).astype(int)[:-1]:
    axes.plot(x[order, sample], y[order, sample], color="black", linewidth=0.9)

units = dict(zip(data["state"].values, data["state_units"].values))
axes.set(xlabel=f"{a} ({units[a]})", ylabel=f"{b} ({units[b]})", title=title)
axes.autoscale_view()
figure.colorbar(plt.cm.ScalarMappable(norm, "viridis"), ax=axes, label="V, cost to the equilibrium")
figure.savefig(target)
