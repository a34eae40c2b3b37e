"""Problems, values and laws: what users see of the engine."""

from __future__ import annotations

import json
import os
import sys
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import _engine, _files, _toml
from .errors import CostateWarning, InputError, Interrupted

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr

_NUMERICS: dict[str, Any] = {
    "backend": "auto",
    "adapter": None,
    "precision": None,
    "method": None,
    "rtol": None,
    "seed": 0,
    "time_limit": None,
    "progress": None,
}


if sys.platform == "linux":
    # The Vulkan loader complains on standard error where this is unset, though nothing needs it.
    os.environ.setdefault("XDG_RUNTIME_DIR", tempfile.gettempdir())


def _note(text: str) -> None:
    warnings.warn(text, CostateWarning, stacklevel=4)


def _progress(wanted):
    """A callable for the steps of a computation, and what ends it."""
    if wanted is None or wanted is False:
        return None, lambda: None
    if callable(wanted):
        return wanted, lambda: None
    try:
        from tqdm.auto import tqdm
    except ModuleNotFoundError:
        return None, lambda: None
    bar = tqdm(bar_format="{desc} [{elapsed}]", leave=False)

    def show(step):
        bar.set_description_str(step or "", refresh=True)

    return show, bar.close


def _identifier(name: str) -> str:
    if not (name.isascii() and name.isidentifier()):
        raise InputError(f"name = {name!r}: an identifier of C")
    return name


def _assignments(values: Mapping) -> list[tuple[str, str]]:
    def text(value):
        return value if isinstance(value, str) else repr(float(value))

    return [(name, text(value)) for name, value in values.items()]


class Problem:
    """A system, its cost and its region.

    A problem is read from a scene (:meth:`load`, :meth:`parse`) or made of its parts, which are named
    as in a scene::

        p = pycostate.Problem(
            states={"x": {"unit": "m"}, "v": {"unit": "m/s"}},   # or ["x", "v"]
            controls={"u": {"min": -2, "max": 2}},
            dynamics={"x": "v", "v": "-x + u"},
            running="0.5*(x^2 + v^2 + u^2)",
            equilibrium={"x": 0, "v": 0, "u": 0},
            region={"x": [-1, 1], "v": [-1, 1]},
        )

    Parameters
    ----------
    states, controls, disturbances : dict or list of str
        By name; what is said of each is as in a scene (``unit``, ``long_name``, ``period``, ``min``,
        ``max``).
    dynamics : dict of str
        The rate of each state, as an expression.
    running, terminal : str
        The running cost, and the cost at ``final_time``.
    final_time : float
        Of a finite horizon; without it the horizon is infinite and ``equilibrium`` is needed.
    **sections
        Further sections of a scene: ``parameters``, ``region``, ``shoot_out``, ``homotopy``, ``map``,
        ``feedback``, ``closed_loop``, ``guards``, ``integrator``, ``mechanism`` and so on.

    A problem does not change: :meth:`set`, :meth:`having` and :meth:`using` give another one.
    """

    def __init__(
        self,
        *,
        states=None,
        controls=None,
        dynamics=None,
        running=None,
        terminal=None,
        final_time=None,
        name="problem.toml",
        **sections,
    ):
        cost = dict(sections.pop("cost", {}))
        for key, value in (
            ("running", running),
            ("terminal", terminal),
            ("final_time", final_time),
        ):
            if value is not None:
                cost[key] = value

        def named(what):
            if what is None or isinstance(what, Mapping):
                return what
            return {n: {} for n in ([what] if isinstance(what, str) else what)}

        if "disturbances" in sections:
            sections["disturbances"] = named(sections["disturbances"])
        plain = {k: v for k, v in sections.items() if not isinstance(v, Mapping)}
        rest = {k: v for k, v in sections.items() if isinstance(v, Mapping)}
        parts = {
            "states": named(states),
            "controls": named(controls),
            "dynamics": dynamics,
            "cost": cost or None,
        }
        parts = {k: v for k, v in parts.items() if v is not None}
        text = _toml.dumps({**plain, **parts, **rest})
        self._begin(_engine.Scene.parse(text, name, []), dict(_NUMERICS))

    def _begin(self, scene, numerics):
        self._scene = scene
        self._numerics = numerics

    @classmethod
    def _of(cls, scene, numerics=None):
        made = cls.__new__(cls)
        made._begin(scene, dict(numerics or _NUMERICS))
        return made

    @classmethod
    def load(cls, path, **set) -> Problem:
        """Reads a scene's file; ``set`` are parameters in place of the file's (numbers, or expressions
        of earlier parameters)."""
        return cls._of(_engine.Scene.load(os.fspath(path), _assignments(set)))

    @classmethod
    def parse(cls, text: str, name: str = "scene.toml", **set) -> Problem:
        """Reads a scene's text."""
        return cls._of(_engine.Scene.parse(text, name, _assignments(set)))

    @classmethod
    def of(cls, result) -> Problem:
        """The problem that a result is of: a file's path, a Dataset or a DataTree."""
        return cls._of(_engine.scene_of_file(_files.file_of(result).path))

    # Other problems.

    def set(self, **values) -> Problem:
        """The same with other values of its parameters; what follows from them follows."""
        given = dict(self._scene.set)
        given.update(_assignments(values))
        scene = _engine.Scene.parse(
            self._scene.text, self._scene.file_name, list(given.items())
        )
        return self._of(scene, self._numerics)

    def having(self, **sections) -> Problem:
        """The same with other sections: a dict is merged into the section, None takes it away.

        >>> p.having(map={"error": 1e-3}, homotopy=None)
        """
        text = _toml.dumps(_toml.merged(_toml.loads(self._scene.text), sections))
        scene = _engine.Scene.parse(text, self._scene.file_name, self._scene.set)
        return self._of(scene, self._numerics)

    def using(self, **numerics) -> Problem:
        """The same, computed otherwise.

        Parameters
        ----------
        backend : {"auto", "cpu", "gpu"}
        adapter : str
            A part of the name of the GPU's adapter.
        precision : {"f64", "f32"}
        method : {"rk4", "tsit5", "dop853", "taylor"}
        rtol : float
            Relative tolerance of a step.
        seed : int
            Of the random samples by which errors are estimated.
        time_limit : float
            Seconds after which a computation ends with what is done.
        progress : bool or callable
            True shows what goes on (by tqdm, where that is installed); a callable is given each step
            as a text, or None where one has ended.

        All methods that compute take these, too.
        """
        return self._of(self._scene, {**self._numerics, **self._known(numerics)})

    @staticmethod
    def _known(numerics):
        for name in numerics:
            if name not in _NUMERICS:
                raise TypeError(
                    f"{name} is no option: there are {', '.join(sorted(_NUMERICS))}"
                )
        return numerics

    # What it is.

    @property
    def text(self) -> str:
        """The scene, as TOML."""
        return self._scene.text

    @property
    def title(self) -> str:
        return self._scene.title

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states."""
        return tuple(name for name, _, _ in self._scene.states)

    @property
    def controls(self) -> tuple[str, ...]:
        """Names of the controls."""
        return tuple(name for name, _, _ in self._scene.controls)

    @property
    def parameters(self) -> dict[str, float]:
        """Values of the parameters."""
        return dict(self._scene.parameters)

    @property
    def reference(self) -> dict[str, float]:
        """The states at the equilibrium, or where the terminal cost is expanded."""
        return dict(zip(self.states, self._scene.reference))

    @property
    def region(self) -> dict[str, tuple[float, float]]:
        """Bounds of each state."""
        return {n: tuple(b) for n, b in zip(self.states, self._scene.region)}

    def save(self, path) -> None:
        """Writes the scene's file."""
        Path(path).write_text(self.text, encoding="utf-8")

    def __repr__(self):
        return f"<pycostate.Problem {self.title!r}: states {', '.join(self.states)}; controls {', '.join(self.controls)}>"

    def _repr_html_(self):
        from html import escape

        return f"<b>{escape(self.title)}</b><pre>{escape(self.text)}</pre>"

    def check(self) -> Check:
        """What follows from the problem: equations, the local solution, guards."""
        text, summary, notes = self._scene.check()
        for note in notes:
            warnings.warn(note, CostateWarning, stacklevel=2)
        return Check(text, json.loads(summary))

    # What it computes.

    def _do(self, compute, numerics, out, group=None):
        """Computes into a file; a group of it as a Dataset, or all as a DataTree."""
        how = {**self._numerics, **self._known(numerics), "note": _note}
        how["progress"], close = _progress(how["progress"])
        with _files.Target(out) as target:
            try:
                path, summary, stopped, interrupted = compute(target.path, how)
            finally:
                close()
            file = target.file(path)
        if interrupted is not None and not isinstance(interrupted, KeyboardInterrupt):
            raise interrupted
        made = None
        if group is None:
            made = _files.tree(file)
        elif not stopped or _files.has(file, group):
            made = _files.dataset(file, group)
        if interrupted is not None:
            raise Interrupted(
                "ended before all was done; what was done by then is in `result` of this exception",
                made,
            ) from interrupted
        if stopped:
            warnings.warn(
                "ended by the time limit before all was done", CostateWarning, stacklevel=3
            )
        return made

    def _run(self, what, x, options, numerics, out, group):
        def compute(path, how):
            return _engine.run(self._scene, what, path, how, x, **options)

        return self._do(compute, numerics, out, group)

    def run(self, *, out=None, keep="all", grid_guesses=False, **numerics) -> xr.DataTree:
        """All that the scene asks for, as ``costate run``: an ``xarray.DataTree`` with the result
        file's groups.

        Parameters
        ----------
        out : path
            The result file; without it there is none that lasts.
        keep : {"all", "values", "nothing"}
            What is kept of swept trajectories.
        grid_guesses : bool
            First guesses also come from V on a grid.
        """
        options = {"kept": keep, "grid_guesses": grid_guesses}
        return self._run("run", None, options, numerics, out, None)

    def sweep(self, *, out=None, keep="all", **numerics) -> xr.Dataset:
        """Trajectories outward from the equilibrium (or the terminal cost): the result file's
        ``/trajectories`` as an ``xarray.Dataset`` with t, x, p, u, V, H over (trajectory, sample) and
        their components."""
        options = {"kept": keep}
        return self._run("sweep", None, options, numerics, out, "trajectories")

    def homotopy(self, *, out=None, grid_guesses=False, **numerics) -> xr.DataTree:
        """V, p and u at the states that ``[homotopy]`` and ``[map]`` of the scene ask for: a DataTree
        with ``points``, ``points_sheets`` and ``map``."""
        options = {"grid_guesses": grid_guesses}
        return self._run("homotopy", None, options, numerics, out, None)

    def solve(
        self,
        points=None,
        /,
        *,
        out=None,
        one_sheet=False,
        trajectories=False,
        samples=200,
        grid_guesses=False,
        **states_and_numerics,
    ) -> xr.Dataset:
        """V, p and u at chosen states.

        >>> p.solve(theta=np.linspace(-5, 3, 171), omega=0.0)
        >>> p.solve(points)          # an array (N, states), or a Dataset with the states by name

        Parameters
        ----------
        points : array_like, Dataset or DataFrame
            States, absolute and in the scene's units. A Dataset's dimensions are the result's.
        **states_and_numerics
            Values of states by name: each array of one dimension is a dimension of the result, numbers
            are coordinates without. States that are not named are at the equilibrium. Also the options
            of :meth:`using`.
        one_sheet : bool
            One solution a state is enough: faster, but it may not be the least.
        trajectories : bool
            Also the optimal trajectory from each state, with so many ``samples``: then the result is a
            DataTree with ``points`` and ``trajectories``.
        grid_guesses : bool
            First guesses also come from V on a grid.

        Returns
        -------
        xarray.Dataset
            The result file's ``/points`` over the dimensions of what was given: V, p (a state each), u
            (a control each), sheet, status, evidence and so on. A state without an answer has V = NaN
            and a status that says why.
        """
        named = {k: states_and_numerics.pop(k) for k in self.states if k in states_and_numerics}
        places = _Places(self, points, named)
        options = {
            "one_sheet": one_sheet,
            "samples": int(samples) if trajectories else None,
            "grid_guesses": grid_guesses,
        }
        group = None if trajectories else "points"
        try:
            made = self._run("solve", places.x, options, states_and_numerics, out, group)
        except Interrupted as stopped:
            if group is not None and stopped.result is not None:
                stopped.result = places.shaped(stopped.result)
            raise
        return made if trajectories or made is None else places.shaped(made)

    def map(self, error=None, *, value_max=None, counts=None, out=None, **numerics) -> xr.Dataset:
        """V over the whole region.

        Parameters
        ----------
        error : float
            The largest error of V wanted: the map is then in pieces, which :meth:`value` evaluates
            anywhere. Without it the scene's ``[map]`` counts.
        value_max : float
            V up to which states count.
        counts : int or dict
            Points along each axis of the grid that is returned (default: 101 in one and two states,
            fewer in more). Not for a scene's own grid.

        Returns
        -------
        xarray.Dataset
            The result file's ``/map``: V, p, u over the states' axes, with errors where the map is in
            pieces.
        """
        problem, changes = self, {"homotopy": None, "feedback": None, "closed_loop": None}
        if error is not None or value_max is not None:
            own = {"error": error, "value_max": value_max}
            changes["map"] = {k: float(v) for k, v in own.items() if v is not None}
        there = _toml.loads(self.text)
        changes = {k: v for k, v in changes.items() if v is not None or k in there}
        if changes:
            problem = self.having(**changes)
        tree = problem._run("homotopy", None, {}, numerics, out, None)
        file = _files.file_of(tree)
        if _files.has(file, "map_pieces"):
            return Value(file).grid(counts=counts)
        return _files.dataset(file, "map")

    def study(self, *, out=None, **numerics) -> xr.Dataset:
        """The scene's ``[study]``: ``/study`` as a Dataset, one row a variant."""

        def compute(path, how):
            return _engine.study(self._scene, path, how)

        return self._do(compute, numerics, out, "study")

    def attenuation(self, *, out=None, **numerics) -> xr.DataTree:
        """The smallest levels of attenuation of the scene's ``[attenuation]``, as a DataTree."""

        def compute(path, how):
            return _engine.attenuation(self._scene, path, how)

        return self._do(compute, numerics, out)

    def simulate(
        self,
        law=None,
        x0=None,
        /,
        *,
        time=None,
        events=None,
        samples=None,
        cycle=None,
        out=None,
        **states_and_numerics,
    ) -> xr.DataTree:
        """Flights forward in time, with the scene's events.

        Parameters
        ----------
        law : Law, str or callable
            What controls: a fitted law, the name of one of the scene's (``"lqr"``), or any function of
            states (N, states) that gives controls (N, controls), such as ``p.value(m).u``. None: the
            scene's, or controls as they are at the equilibrium. A function is called by Python, a stage
            of a step for all flights at once; controls are kept within their bounds, flights end where a
            guard is left, and events are refused.
        x0 : array_like, Dataset
            States to begin with, as the points of :meth:`solve`; also by name.
        time : float
            How long a flight lasts.
        events : int
            Events after which one ends.
        samples : int
            Stored points of each phase.
        cycle : int
            An orbit is looked for that comes back to itself after so many events.

        Returns
        -------
        xarray.DataTree
            ``simulation``, ``simulation_events``, ``simulation_samples``, and ``cycles`` where orbits
            were looked for. Under a function ``simulation`` has J, too, the running cost.
        """
        if callable(law) and not isinstance(law, Law):
            return self._fly(law, x0, time, samples, events or cycle or out, states_and_numerics)
        named = {k: states_and_numerics.pop(k) for k in self.states if k in states_and_numerics}
        x = _Places(self, x0, named).x if x0 is not None or named else None
        options = {"time": time, "events": events, "samples": samples, "cycle": cycle}
        if isinstance(law, Law):
            options["weights"] = (law.name, law.to_toml())
        elif law is not None:
            options["law"] = law

        def compute(path, how):
            return _engine.simulate(self._scene, path, how, x, **options)

        return self._do(compute, states_and_numerics, out)

    def _fly(self, law, x0, time, samples, others, states_and_numerics):
        from . import _functions

        if others:
            raise InputError("events, cycle and out are not for laws of Python")
        named = {k: states_and_numerics.pop(k) for k in self.states if k in states_and_numerics}
        how = {**self._numerics, **self._known(states_and_numerics)}
        system = _engine.System(self._scene)
        given = _toml.loads(self.text).get("simulation", {})
        x = _Places(self, x0, named).x
        for value in (time, given.get("time"), self._scene.time[1]):
            if value is not None:
                time = value
                break
        if time is None or not 0 < float(time) < float("inf"):
            raise InputError(f"time = {time}: how long to simulate?")
        samples = given.get("samples", 50) if samples is None else int(samples)
        rtol = 1e-8 if how["rtol"] is None else float(how["rtol"])
        progress, close = _progress(how["progress"])

        def tell(share):
            if progress is not None:
                progress(f"simulated: {100 * share:.0f} %")

        try:
            done = _functions.fly(self, system, law, x, float(time), samples, rtol, tell)
        finally:
            close()
        name = getattr(law, "__qualname__", type(law).__name__)
        return _functions.tree(self, system, done, time, name, rtol)

    def evaluate(
        self, result=None, *, laws=None, added=(), random=None, solve=False, out=None, **numerics
    ) -> xr.DataTree:
        """Laws side by side from many initial states, as ``[closed_loop]`` and ``[dissipation]`` ask.

        Parameters
        ----------
        result : path, Dataset or DataTree
            Where V and fitted laws come from.
        laws : list of str
            Only these.
        added : list of Law
            Further laws.
        random : int
            So many initial states at random.
        solve : bool
            V at the initial states is solved for.
        """
        stored = None if result is None else _files.file_of(result)
        options = {
            "laws": None if laws is None else list(laws),
            "weights": [(law.name, law.to_toml()) for law in added],
            "random": random,
            "solve": solve,
        }

        def compute(path, how):
            given = None if stored is None else stored.path
            return _engine.evaluate(self._scene, path, how, given, **options)

        return self._do(compute, numerics, out)

    def local_to_c(self, path=None, *, degree=3, name="local") -> str:
        """The series of V and u about the equilibrium, u of a degree, as a header of C; also written to
        a file."""
        if degree not in range(1, 7):
            raise InputError(f"degree = {degree}: a whole number from 1 to 6")
        text = self._scene.local_to_c(_identifier(name), int(degree))
        if path is not None:
            Path(path).write_text(text, encoding="utf-8")
        return text

    def value(self, result) -> Value:
        """V, p and u at any state, interpolated from a result (a file, Dataset or DataTree)."""
        return Value(_files.file_of(result))

    def fit(
        self, result, *, names=None, starts=None, seed=None, directory=None, **numerics
    ) -> Law | dict[str, Law]:
        """Fits the laws of the scene's ``[feedback]`` to what a result holds.

        Parameters
        ----------
        result : path, Dataset or DataTree
            Swept trajectories, solved states or a map in pieces; the laws are written into the file.
        names : list of str
            Only these laws.
        starts, seed : int
            Of the optimization, in place of the scene's.
        directory : path
            Where the laws' files go (weights, C, ONNX); default: nowhere.

        Returns
        -------
        Law, or dict of Law
            By name, where there are several.
        """
        file = _files.file_of(result)
        how = {**self._numerics, **self._known(numerics), "note": _note}
        how["progress"], close = _progress(how["progress"])
        with tempfile.TemporaryDirectory(prefix="pycostate-") as folder:
            try:
                laws, left_out, interrupted = _engine.fit(
                    self._scene,
                    file.path,
                    os.fspath(directory or folder),
                    how,
                    names=None if names is None else list(names),
                    starts=starts,
                    seed=seed,
                )
            finally:
                close()
        made = {law.name: Law(law, self) for law in laws}
        if interrupted is not None:
            raise Interrupted("ended before all laws were fitted", made) from interrupted
        if left_out:
            warnings.warn(
                f"no time was left for {', '.join(left_out)}", CostateWarning, stacklevel=2
            )
        return next(iter(made.values())) if len(made) == 1 and not left_out else made


class Check:
    """What follows from a problem.

    Attributes
    ----------
    summary : dict
        What ``costate check --json`` prints.
    P, K : numpy.ndarray
        V = s'Ps/2 and u = u_e - K s about the equilibrium, (states, states) and (controls, states);
        None on a finite horizon.
    eigenvalues : numpy.ndarray
        Of the closed loop at the equilibrium, complex.
    hamiltonian : str
    optimal_control, state_equations, adjoint_equations : dict of str
    """

    def __init__(self, text, summary):
        self.text = text
        self.summary = summary

    def _array(self, name):
        import numpy as np

        given = self.summary[name]
        return None if given is None else np.array(given, dtype=float)

    @property
    def P(self) -> np.ndarray | None:
        return self._array("riccati")

    @property
    def K(self) -> np.ndarray | None:
        return self._array("gain")

    @property
    def eigenvalues(self) -> np.ndarray | None:
        pairs = self._array("closed_loop_eigenvalues")
        return None if pairs is None else pairs[:, 0] + 1j * pairs[:, 1]

    @property
    def hamiltonian(self) -> str:
        return self.summary["hamiltonian"]

    @property
    def optimal_control(self) -> dict:
        return dict(zip(self.summary["controls"], self.summary["optimal_control"]))

    @property
    def state_equations(self) -> dict:
        return dict(zip(self.summary["states"], self.summary["state_equations"]))

    @property
    def adjoint_equations(self) -> dict:
        return dict(zip(self.summary["states"], self.summary["adjoint_equations"]))

    def __repr__(self):
        return self.text.rstrip()

    def _repr_html_(self):
        from html import escape

        return f"<pre>{escape(self.text)}</pre>"


class _Places:
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


class Value:
    """V at any state, and p = dV/dx, u, the error.

    Calls take states as an array (..., states), or by name; on a finite horizon also a time ``t``
    (default 0). They return an array of the shape (...), with p and u (..., states) and (...,
    controls); NaN where nothing is known.

    >>> v = p.value(p.map(error=1e-3))
    >>> v([0.5, 0.0]), v.p([0.5, 0.0]), v.u([0.5, 0.0])
    >>> v(theta=np.linspace(-1, 1, 11), omega=0.0)      # the usual broadcasting
    """

    def __init__(self, result):
        self._file = _files.file_of(result)
        self._map = _engine.Value(self._file.path)
        self.problem = Problem.of(self._file)

    def _states(self, x, named):
        import numpy as np

        names = self.problem.states
        if x is None:
            unknown = [n for n in named if n not in names]
            if unknown:
                raise InputError(f"{unknown[0]} is no state of the scene ({', '.join(names)})")
            reference = self.problem.reference
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

    def _ask(self, which, x, t, named):
        import numpy as np

        rows, shape = self._states(x, named)
        if t is None or (np.ndim(t) == 0 and t == 0):
            found = self._map.many(rows)
        else:
            times = np.ascontiguousarray(np.broadcast_to(np.asarray(t, float), shape)).ravel()
            found = self._map.at(rows, times, False)
        values = found[which]
        return values.reshape(shape + (-1,) if which in "pu" else shape)[()]

    def __call__(self, x=None, /, *, t=None, **states) -> np.ndarray:
        """V."""
        return self._ask("V", x, t, states)

    def p(self, x=None, /, *, t=None, **states) -> np.ndarray:
        """dV/dx, one component a state."""
        return self._ask("p", x, t, states)

    def u(self, x=None, /, *, t=None, **states) -> np.ndarray:
        """The optimal controls."""
        return self._ask("u", x, t, states)

    def _all(self, x, t, named):
        import numpy as np

        rows, shape = self._states(x, named)
        times = np.ascontiguousarray(
            np.broadcast_to(np.asarray(0.0 if t is None else t, float), shape)
        ).ravel()
        return self._map.at(rows, times, True), shape

    def error(self, x=None, /, *, t=None, **states) -> np.ndarray:
        """Estimated error of V."""
        found, shape = self._all(x, t, states)
        return found["V_error"].reshape(shape)[()]

    def status(self, x=None, /, *, t=None, **states) -> np.ndarray:
        """What is known: "interpolated", or why nothing is."""
        import numpy as np

        found, shape = self._all(x, t, states)
        words = dict(self._map.statuses())
        return np.array([words[c] for c in found["status"].tolist()], object).reshape(shape)[()]

    def at(self, points=None, /, *, t=None, **states) -> xr.Dataset:
        """V, p, u, their errors, the sheet and the status at states given as for
        :meth:`Problem.solve`, as a Dataset."""
        import numpy as np

        places = _Places(self.problem, points, states)
        times = np.full(len(places.x), 0.0 if t is None else float(t))
        with _files.Target(None) as target:
            self._map.write(target.path, places.x, times)
            file = target.file()
        return places.shaped(_files.dataset(file, "points"))

    def grid(self, *, counts=None, t=None, out=None, **axes) -> xr.Dataset:
        """The same on a grid, as the Dataset ``/map``.

        Parameters
        ----------
        counts : int or dict of int
            Points of each axis over the region; an axis may also be given itself, by name.
        """
        import numpy as np

        names = self.problem.states
        default = {1: 401, 2: 101, 3: 41, 4: 15}.get(len(names), 5)
        lines = []
        for name in names:
            count = counts.get(name, default) if isinstance(counts, Mapping) else counts or default
            given = axes.pop(name, None)
            line = np.linspace(*self.problem.region[name], int(count)) if given is None else given
            lines.append(np.atleast_1d(np.asarray(line, dtype=float)))
        if axes:
            raise InputError(f"{next(iter(axes))} is no state of the scene ({', '.join(names)})")
        all_lines = list(lines)
        if self._map.has_time:
            all_lines.append(np.atleast_1d(np.asarray(0.0 if t is None else t, dtype=float)))
        mesh = np.stack(np.meshgrid(*all_lines, indexing="ij"), axis=-1).reshape(-1, len(all_lines))
        x = np.ascontiguousarray(mesh[:, : len(names)])
        times = np.ascontiguousarray(mesh[:, -1]) if self._map.has_time else np.zeros(len(x))
        with _files.Target(out) as target:
            self._map.write(target.path, x, times, [line.tolist() for line in all_lines])
            file = target.file()
        made = _files.dataset(file, "map")
        # What was asked knows more than what it has answered.
        return _files._held(made, self._file if out is None else file)

    def to_c(self, path=None, *, name="map") -> str:
        """V and u of a map in pieces as a header of C without dependencies; also written to a file.
        What it defines begins with ``name``."""
        text = self._map.to_c(_identifier(name))
        if path is not None:
            Path(path).write_text(text, encoding="utf-8")
        return text

    def __repr__(self):
        return f"<pycostate.Value of {self.problem.title!r}, {self._file.path}>"


class Law:
    """A feedback law u(x).

    Calls take states as an array (..., states), or by name, and return an array (..., controls).
    """

    def __init__(self, law, problem):
        self._law = law
        self.problem = problem

    @property
    def name(self) -> str:
        return self._law.name

    @property
    def outputs(self) -> tuple[str, ...]:
        """What it gives: names of controls (or of commanded states)."""
        return tuple(self._law.outputs)

    def __call__(self, x=None, /, **states) -> np.ndarray:
        rows, shape = Value._states(self, x, states)
        return self._law.eval(rows).reshape(shape + (-1,))

    def to_toml(self) -> str:
        """The weights file's text."""
        return self._law.to_toml()

    def to_c(self, path=None) -> str:
        """A header of C without dependencies; also written to a file."""
        text = self._law.to_c()
        if path is not None:
            Path(path).write_text(text, encoding="utf-8")
        return text

    def to_onnx(self, path=None) -> bytes:
        """An ONNX model; also written to a file."""
        model = bytes(self._law.to_onnx())
        if path is not None:
            Path(path).write_bytes(model)
        return model

    def save(self, path) -> None:
        """Writes a file by its ending: ``.toml`` (weights), ``.h`` or ``.onnx``."""
        ending = Path(path).suffix.lower()
        if ending == ".onnx":
            self.to_onnx(path)
        elif ending == ".h":
            self.to_c(path)
        elif ending == ".toml":
            Path(path).write_text(self.to_toml(), encoding="utf-8")
        else:
            raise InputError(f"{path}: name a file .toml (weights), .h (C) or .onnx")

    def __repr__(self):
        return f"<pycostate.Law {self.name!r} of {self.problem.title!r}: {', '.join(self.outputs)}>"


def load_law(path, problem: Problem) -> Law:
    """The law of a weights file."""
    path = Path(path)
    text = path.read_text(encoding="utf-8")
    return Law(_engine.Law.parse(path.stem, text, str(path), problem._scene), problem)


def open(path) -> xr.DataTree:
    """A result file as an ``xarray.DataTree``: its groups, by the names of the file."""
    if not Path(path).exists():
        raise FileNotFoundError(f"{path} is not there")
    # What is no result file is told with its reason.
    _engine.scene_of_file(os.fspath(path))
    return _files.tree(_files.ResultFile(path))


class Report:
    """A page with pictures; a notebook shows it."""

    def __init__(self, page, pictures, missing):
        self.page = Path(page)
        self.pictures = list(pictures)
        self.missing = dict(missing)

    @property
    def html(self) -> str:
        return self.page.read_text(encoding="utf-8")

    def _repr_html_(self):
        from html import escape

        return f'<iframe srcdoc="{escape(self.html, quote=True)}" width="100%" height="800" style="border:0"></iframe>'

    def __repr__(self):
        return f"<pycostate.Report {self.page}: {', '.join(self.pictures)}>"


def report(result, page=None, *, axes=None, slice=None, levels=(), width=None) -> Report:
    """The report of a result: a page of HTML, and its pictures beside it.

    Parameters
    ----------
    result : path, Dataset or DataTree
    page : path
        Where it goes; default: beside the result file.
    axes : pair of str
        The states of the plane that is shown.
    slice : dict of float
        Where the plane lies.
    levels : list of float
        Contours of V.
    width : int
        Of the pictures, in pixels.
    """
    file = _files.file_of(result)
    page = file.path.with_name(file.path.stem + "_report.html") if page is None else Path(page)
    made = _engine.report(
        file.path,
        page,
        axes=None if axes is None else list(axes),
        slice=[(k, float(v)) for k, v in (slice or {}).items()],
        levels=[float(v) for v in levels],
        width=width,
    )
    done = Report(*made)
    done._file = file
    return done
