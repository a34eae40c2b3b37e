"""Pictures of results in matplotlib, in the report's colours: ``ds.costate.contours()`` and so on."""

from __future__ import annotations

import numbers

from . import _options
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
    axes = _options.words(axes)
    if len(axes) != 2 or axes[0] == axes[1]:
        raise InputError(f"axes = {axes}: two different states")
    x, y = axes
    for name in (x, y):
        if name not in states:
            raise InputError(f"{name} is no state ({', '.join(states)})")
    return x, y


def _levels(v, wanted):
    """Levels of contours: as the report has them, 1, 2, 5 times powers of ten up to the largest V where V
    is nowhere negative, else evenly spaced."""
    import numpy as np

    least, most = np.nanmin(v), np.nanmax(v)
    if wanted is not None and not isinstance(wanted, numbers.Integral):
        levels = np.unique(np.asarray(wanted, dtype=float))
        if levels.size < 2 or not np.isfinite(levels).all():
            raise InputError("levels: two finite numbers at least")
        return levels
    if wanted is None and most > 0 and least >= -1e-9 * abs(most):
        top = int(np.ceil(np.log10(most)))
        steps = [f * 10.0**e for e in range(top - 4, top + 1) for f in (1, 2, 5)]
        inside = [s for s in steps if most * 1e-3 < s < most * 0.93]
        return np.array([min(0.0, least), *inside, most])
    count = BANDS if wanted is None else _options.whole("levels", wanted, 1, 1000)
    return np.linspace(least, most, count + 1) if most > least else np.array([least - 1, least, least + 1])


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
            value = _options.number(name, value)
            ds = ds.sel({name: value}, method="nearest")
        left = list(ds.V.dims)
        if "point" in left or "trajectory" in left:
            raise InputError("V is no grid here: p.map(), v.grid() or p.solve() with axes make one")
        return ds, left

    def save(self, path):
        """Copies the result file that it was made of to ``path``."""
        import shutil

        from . import _files

        file = _files.file_of(self._ds)
        try:
            shutil.copyfile(file.path, _files._file(_options.out(path)))
        except shutil.SameFileError:
            raise InputError(f"{path} is the file itself") from None

    def _quantity(self, ds, name):
        """A variable, or a component of p or u, and its label."""
        if not isinstance(name, str):
            raise InputError(f"{name!r}: the name of what is drawn")
        if name in ("V", "V_error", "p_error", "u_error") and name in ds:
            return ds[name], _label(ds, name)
        if name.startswith("p_") and name[2:] in _states(ds):
            return ds.p.sel(state=name[2:]), name
        if "control" in ds.coords and name in ds.coords["control"].values:
            return ds.u.sel(control=name), _label(ds, name)
        raise InputError(f"{name} is neither V, an error, a control nor p_STATE")

    def contours(self, quantity="V", *, levels=None, ax=None, colorbar=True, **at):
        """V, or a component of p or u, over a plane as filled contours, with the lines where the cheapest
        sheet changes.

        Parameters
        ----------
        quantity : str
            ``"V"``, ``"V_error"``, the name of a control, or ``"p_NAME"`` of a state.
        levels : int or list of float
            Bands, or where they end; default: the report's.
        ax : matplotlib axes
        colorbar : bool
        **at : float
            Where the plane lies, by name, where V has more than two axes; those not named lie at the
            middle of their axis.
        """
        import numpy as np

        ds, left = self._grid(at)
        at = {name: float(ds[name]) for name in at}
        for name in left[2:]:
            middle = ds[name].values[len(ds[name]) // 2]
            ds = ds.sel({name: middle})
            at[name] = float(middle)
        if len(left) < 2 or min(ds.sizes[n] for n in left[:2]) < 2:
            raise InputError("V has one axis here: slice() draws it")
        x, y = left[:2]
        values, label = self._quantity(ds, quantity)
        v = values.transpose(y, x).values
        if not np.isfinite(v).any():
            raise InputError(f"{quantity} is known nowhere in this plane")
        ax = _axes(ax)
        if quantity == "V":
            levels = _levels(v, levels)
        else:
            levels = _levels(v, BANDS if levels is None else levels)
        colours = {"cmap": "viridis"}
        if levels[0] >= 0 and quantity == "V":
            from matplotlib.colors import BoundaryNorm

            colours["norm"] = BoundaryNorm(levels, 256)
        drawn = ax.contourf(ds[x].values, ds[y].values, v, levels=levels, **colours)
        lines = ax.contour(ds[x].values, ds[y].values, v, levels=levels, colors="k", linewidths=0.3)
        ax.clabel(lines, fontsize="x-small", fmt="%g")
        if "sheet" in ds:
            sheet = ds.sheet.transpose(y, x).values.astype(float)
            # About the equilibrium the local solution is no sheet of its own.
            sheet[~np.isfinite(v) | (sheet < 0)] = np.nan
            self._changes(ax, ds[x].values, ds[y].values, sheet)
        if colorbar:
            ax.figure.colorbar(drawn, ax=ax, label=label)
        ax.set_xlabel(_label(ds, x))
        ax.set_ylabel(_label(ds, y))
        where = ", ".join(f"{name} = {value:g}" for name, value in at.items())
        ax.set_title(quantity + (f" at {where}" if where else ""))
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
        values, label = self._quantity(ds, quantity)
        ax = _axes(ax)
        place, values = ds[x].values, values.values
        sheets = ds.sheet.values if "sheet" in ds else np.zeros(len(place), int)
        if (sheets >= 0).any():
            # About the equilibrium the local solution belongs to the sheet beside it.
            numbered = np.flatnonzero(sheets >= 0)
            nearest = np.abs(place[:, None] - place[numbered]).argmin(axis=1)
            sheets = np.where(sheets < 0, sheets[numbered][nearest], sheets)
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
        count = _options.whole("count", count, 1)
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
        lines, _ = self._lines(_options.whole("count", count, 1))
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
    """Makes pictures an accessor of Datasets and of nodes of DataTrees, once."""
    import xarray as xr

    def of_node(node):
        from . import _files

        ds = node.to_dataset()
        return Pictures(_files._held(ds, _files.file_of(node)))

    if not hasattr(xr.Dataset, "costate"):
        xr.register_dataset_accessor("costate")(Pictures)
    if not hasattr(xr.DataTree, "costate"):
        xr.register_datatree_accessor("costate")(of_node)
