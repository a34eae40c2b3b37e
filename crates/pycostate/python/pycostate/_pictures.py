"""Pictures of results in matplotlib, in the report's colours: ``ds.costate.contours()`` and so on."""

from __future__ import annotations

from .errors import InputError

#: M. Okabe, K. Ito, Color Universal Design (2008), without the yellow: classes that the colour-blind
#: tell apart.
CLASSES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#6e6e6e")
#: Bands of V.
BANDS = 12
#: Trajectories of a picture.
SHOWN = 64


def _axes(ax):
    if ax is not None:
        return ax
    try:
        import matplotlib.pyplot as plt
    except ModuleNotFoundError as missing:
        raise InputError("pictures need matplotlib: pip install pycostate[pictures]") from missing
    return plt.subplots()[1]


def _label(ds, name: str) -> str:
    """Description and unit of a state, a control or a variable."""
    for group in ("state", "control"):
        names = [str(n) for n in ds.coords[group].values] if group in ds.coords else []
        if name in names and f"{group}_units" in ds.coords:
            at = names.index(name)
            unit = str(ds.coords[f"{group}_units"].values[at])
            words = str(ds.coords[f"{group}_long_name"].values[at])
            words = name if words in ("", name) else f"{words} {name}"
            return words if unit in ("", "1") else f"{words} ({unit})"
    if name in ds.variables:
        unit = ds[name].attrs.get("units", "1")
        return name if unit in ("", "1") else f"{name} ({unit})"
    return name


def _states(ds) -> list[str]:
    if "state" not in ds.coords:
        raise InputError("this has no states: pictures are of Datasets that pycostate has made")
    return [str(n) for n in ds.coords["state"].values]


def _plane(ds, axes) -> tuple[str, str]:
    states = _states(ds)
    if axes is None:
        if len(states) < 2:
            raise InputError("a plane needs two states")
        return states[0], states[1]
    x, y = axes
    for name in (x, y):
        if name not in states:
            raise InputError(f"{name} is no state ({', '.join(states)})")
    return x, y


class Pictures:
    """Pictures of a Dataset of pycostate; each returns matplotlib's axes and takes ``ax``.

    What is drawn is as in the report: V in bands of viridis, sheets in colours that the colour-blind
    tell apart, and nothing where nothing is known.
    """

    def __init__(self, ds):
        self._ds = ds

    @property
    def file(self):
        """The result file that it was made of, as a DataTree."""
        from . import _files

        return _files.tree(_files.file_of(self._ds))

    def _grid(self, at):
        """V over the axes that are left when some states are fixed (at the nearest point known)."""
        ds = self._ds
        if "V" not in ds:
            raise InputError("this has no V")
        for name in at:
            if name not in ds.V.dims:
                raise InputError(f"{name} is no axis of V ({', '.join(map(str, ds.V.dims))})")
        for name, value in at.items():
            ds = ds.sel({name: value}, method="nearest")
        left = list(ds.V.dims)
        if "point" in left or "trajectory" in left:
            raise InputError("V is no grid here: p.map(), v.grid() or p.solve() with axes make one")
        return ds, left

    def contours(self, *, levels=None, ax=None, colorbar=True, **at):
        """V over a plane as filled contours, with the lines where the cheapest sheet changes.

        Parameters
        ----------
        levels : int or list of float
        **at : float
            Where the plane lies, by name, where V has more than two axes; those not named lie at the
            middle of their axis.
        """
        import numpy as np

        ds, left = self._grid(at)
        for name in left[2:]:
            middle = ds[name].values[len(ds[name]) // 2]
            ds = ds.sel({name: middle})
        if len(left) < 2:
            raise InputError("V has one axis here: slice() draws it")
        x, y = left[:2]
        ax = _axes(ax)
        v = ds.V.transpose(y, x).values
        if not np.isfinite(v).any():
            raise InputError("V is known nowhere in this plane")
        if levels is None or isinstance(levels, int):
            levels = np.linspace(np.nanmin(v), np.nanmax(v), (levels or BANDS) + 1)
        drawn = ax.contourf(ds[x].values, ds[y].values, v, levels=levels, cmap="viridis")
        ax.contour(ds[x].values, ds[y].values, v, levels=levels, colors="k", linewidths=0.3)
        if "sheet" in ds:
            sheet = ds.sheet.transpose(y, x).values.astype(float)
            sheet[~np.isfinite(v)] = np.nan
            self._changes(ax, ds[x].values, ds[y].values, sheet)
        if colorbar:
            ax.figure.colorbar(drawn, ax=ax, label=_label(ds, "V"))
        ax.set_xlabel(_label(ds, x))
        ax.set_ylabel(_label(ds, y))
        return ax

    @staticmethod
    def _changes(ax, x, y, sheet):
        """Lines between points of different sheets."""
        import numpy as np

        def middle(a):
            return 0.5 * (a[1:] + a[:-1])

        def ends(a):
            return np.concatenate([a[:1], middle(a), a[-1:]])

        xs, ys = ends(x), ends(y)

        def differ(a, b):
            return np.isfinite(a) & np.isfinite(b) & (a != b)

        lines = []
        for j, k in np.argwhere(differ(sheet[:, 1:], sheet[:, :-1])):
            lines.append([(middle(x)[k], ys[j]), (middle(x)[k], ys[j + 1])])
        for j, k in np.argwhere(differ(sheet[1:], sheet[:-1])):
            lines.append([(xs[k], middle(y)[j]), (xs[k + 1], middle(y)[j])])
        if lines:
            from matplotlib.collections import LineCollection

            ax.add_collection(LineCollection(lines, colors="k", linewidths=1.6))

    def slice(self, quantity="V", *, ax=None, **at):
        """V, or a component of p or u, along one axis, in the colours of the sheets.

        Parameters
        ----------
        quantity : str
            ``"V"``, the name of a control, or ``"p_NAME"`` of a state.
        **at : float
            Where the other states are, by name; those not named are at the middle of their axis.
        """
        import numpy as np

        ds, left = self._grid(at)
        for name in left[1:]:
            middle = ds[name].values[len(ds[name]) // 2]
            ds = ds.sel({name: middle})
        if not left:
            raise InputError("no axis is left to draw along")
        x = left[0]
        if quantity == "V":
            values, label = ds.V, _label(ds, "V")
        elif quantity.startswith("p_") and quantity[2:] in _states(ds):
            values, label = ds.p.sel(state=quantity[2:]), quantity
        elif "control" in ds.coords and quantity in ds.coords["control"].values:
            values, label = ds.u.sel(control=quantity), _label(ds, quantity)
        else:
            raise InputError(f"{quantity} is neither V, a control nor p_STATE")
        ax = _axes(ax)
        place, values = ds[x].values, values.values
        sheets = ds.sheet.values if "sheet" in ds else np.zeros(len(place), int)
        for k, sheet in enumerate(np.unique(sheets[np.isfinite(values)])):
            shown = np.where(sheets == sheet, values, np.nan)
            ax.plot(place, shown, ".-", color=CLASSES[k % len(CLASSES)], label=f"sheet {sheet}")
        if len(np.unique(sheets)) > 1:
            ax.legend()
        ax.set_xlabel(_label(ds, x))
        ax.set_ylabel(label)
        return ax

    def phase(self, axes=None, *, ax=None, count=SHOWN):
        """Trajectories in a plane of two states, coloured by V where it is there, or one colour a
        flight.

        Parameters
        ----------
        axes : pair of str
            The states; default: the first two.
        count : int
            Trajectories that are drawn, evenly chosen.
        """
        import numpy as np

        x, y = _plane(self._ds, axes)
        ax = _axes(ax)
        lines, v = self._lines(count)
        ds = self._ds
        names = _states(ds)
        a, b = names.index(x), names.index(y)
        if v is None:
            for k, (_, states, _) in enumerate(lines):
                ax.plot(states[:, a], states[:, b], color=CLASSES[k % len(CLASSES)], lw=1.4)
        else:
            from matplotlib.collections import LineCollection

            pieces, values = [], []
            for (_, states, _), along in zip(lines, v):
                plane = states[:, [a, b]]
                pieces.extend(np.stack([plane[:-1], plane[1:]], axis=1))
                values.extend(0.5 * (along[1:] + along[:-1]))
            drawn = LineCollection(pieces, array=np.array(values), cmap="viridis", linewidths=0.8)
            ax.add_collection(drawn)
            ax.autoscale_view()
            ax.figure.colorbar(drawn, ax=ax, label=_label(ds, "V"))
        ax.set_xlabel(_label(ds, x))
        ax.set_ylabel(_label(ds, y))
        return ax

    def _lines(self, count):
        """Times, states and controls along each of some trajectories, and V along it."""
        import numpy as np

        ds = self._ds
        if "x" not in ds or "t" not in ds:
            raise InputError("this has no trajectories (x and t): sweep(), simulate() and solve(trajectories=True) make some")
        controls = ds.u if "u" in ds else None
        if ds.x.dims[:1] == ("sample",):
            # Flights with events: each phase is a line.
            flights = ds.flight.values
            phases = ds.phase.values
            chosen = np.unique(flights)[:count]
            lines = []
            for flight in chosen:
                for phase in np.unique(phases[flights == flight]):
                    rows = (flights == flight) & (phases == phase)
                    u = None if controls is None else controls.values[rows]
                    lines.append((ds.t.values[rows], ds.x.values[rows], u))
            return lines, None
        # Laws side by side come first.
        t = ds.t.values.reshape(-1, ds.t.shape[-1])
        x = ds.x.values.reshape(-1, *ds.x.shape[-2:])
        u = None if controls is None else controls.values.reshape(-1, *controls.shape[-2:])
        v = ds.V.values.reshape(t.shape) if "V" in ds and ds.V.shape == ds.t.shape else None
        chosen = np.unique(np.linspace(0, len(t) - 1, min(count, len(t))).astype(int))
        lines, along = [], []
        for k in chosen:
            known = np.isfinite(t[k]) & np.isfinite(x[k]).all(axis=-1)
            lines.append((t[k][known], x[k][known], None if u is None else u[k][known]))
            along.append(None if v is None else v[k][known])
        return lines, None if v is None else along

    def histories(self, *, axes=None, count=8):
        """States and controls against time, one panel each; returns the array of axes."""
        import numpy as np

        ds = self._ds
        lines, _ = self._lines(count)
        states = _states(ds)
        controls = [str(n) for n in ds.coords["control"].values] if "control" in ds.coords else []
        if axes is None:
            import matplotlib.pyplot as plt

            many = len(states) + len(controls)
            _, axes = plt.subplots(many, 1, sharex=True, figsize=(6.4, 1.6 * many + 0.8))
        axes = np.atleast_1d(axes)
        for k, (t, x, u) in enumerate(lines):
            colour = CLASSES[k % len(CLASSES)]
            for panel, values in zip(axes, x.T):
                panel.plot(t, values, color=colour, lw=1.2)
            if u is not None:
                for panel, values in zip(axes[len(states) :], u.T):
                    panel.plot(t, values, color=colour, lw=1.2)
        for panel, name in zip(axes, states + controls):
            panel.set_ylabel(_label(ds, name))
        axes[-1].set_xlabel(_label(ds, "t"))
        return axes


def register() -> None:
    """Makes pictures an accessor of Datasets, once."""
    import xarray as xr

    if not hasattr(xr.Dataset, "costate"):
        xr.register_dataset_accessor("costate")(Pictures)
