"""Problems, values and laws: what users see of the engine."""

from __future__ import annotations

import json
import os
import sys
import tempfile
import warnings
from collections.abc import Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import _engine, _files, _toml
from ._check import Check
from ._law import Law
from ._places import Places, identifier
from ._value import Value
from .errors import CostateWarning, InputError, Interrupted

if TYPE_CHECKING:
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
        """Reads a scene's file, ``path``; ``set`` are parameters in place of the file's (numbers, or
        expressions of earlier parameters)."""
        return cls._of(_engine.Scene.load(os.fspath(path), _assignments(set)))

    @classmethod
    def parse(cls, text: str, name: str = "scene.toml", **set) -> Problem:
        """Reads a scene's ``text``, with ``set`` as in :meth:`load`; ``name`` is what errors call it."""
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
        """The scene's title."""
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
        """Writes the scene's file, ``path``."""
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

    def _named(self, options) -> dict:
        """States that are given by name, taken from among options."""
        return {k: options.pop(k) for k in self.states if k in options}

    @contextmanager
    def _how(self, numerics):
        """How to compute: the problem's options with those of a call, and who is told."""
        how = {**self._numerics, **self._known(numerics), "note": _note}
        how["progress"], close = _progress(how["progress"])
        try:
            yield how
        finally:
            close()

    def _do(self, compute, numerics, out, group=None):
        """Computes into a file; a group of it as a Dataset, or all as a DataTree."""
        with _files.Target(out) as target:
            with self._how(numerics) as how:
                path, _, stopped, interrupted = compute(target.path, how)
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
        their components.

        Parameters
        ----------
        out : path
            The result file; without it there is none that lasts.
        keep : {"all", "values", "nothing"}
            What is kept of them: with "values" x and V alone.
        **numerics
            The options of :meth:`using`.
        """
        options = {"kept": keep}
        return self._run("sweep", None, options, numerics, out, "trajectories")

    def homotopy(self, *, out=None, grid_guesses=False, **numerics) -> xr.DataTree:
        """V, p and u at the states that ``[homotopy]`` and ``[map]`` of the scene ask for: a DataTree
        with ``points``, ``points_sheets`` and ``map``.

        Parameters
        ----------
        out : path
            The result file; without it there is none that lasts.
        grid_guesses : bool
            First guesses also come from V on a grid.
        **numerics
            The options of :meth:`using`.
        """
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
        out : path
            The result file; without it there is none that lasts.
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
        named = self._named(states_and_numerics)
        places = Places(self, points, named)
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
        out : path
            The result file; without it there is none that lasts.
        **numerics
            The options of :meth:`using`.

        Returns
        -------
        xarray.Dataset
            The result file's ``/map``: V, p, u over the states' axes, with errors where the map is in
            pieces.
        """
        problem = self
        changes: dict[str, Any] = {"homotopy": None, "feedback": None, "closed_loop": None}
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
        """The scene's ``[study]``: ``/study`` as a Dataset, one row a variant. ``out`` is the result file;
        ``numerics`` are the options of :meth:`using`."""

        def compute(path, how):
            return _engine.study(self._scene, path, how)

        return self._do(compute, numerics, out, "study")

    def attenuation(self, *, out=None, **numerics) -> xr.DataTree:
        """The smallest levels of attenuation of the scene's ``[attenuation]``, as a DataTree. ``out`` is the
        result file; ``numerics`` are the options of :meth:`using`."""

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
            of a step for all flights at once; controls are kept within their bounds.
        x0 : array_like, Dataset
            States to begin with, as the points of :meth:`solve`; also by name.
        time : float
            How long a flight lasts.
        events : int
            Events after which one ends.
        samples : int
            Stored points of each phase.
        cycle : int
            An orbit is looked for that comes back to itself after so many events; 0: none. Not for
            functions.
        out : path
            The result file; without it there is none that lasts. Not for functions.

        Returns
        -------
        xarray.DataTree
            ``simulation``, ``simulation_events``, ``simulation_samples``, and ``cycles`` where orbits
            were looked for. Under a function ``simulation`` has J, too, the running cost.
        """
        if callable(law) and not isinstance(law, Law):
            asked = {"time": time, "events": events, "samples": samples}
            return self._fly(law, x0, asked, cycle, out, states_and_numerics)
        named = self._named(states_and_numerics)
        x = Places(self, x0, named).x if x0 is not None or named else None
        options = {"time": time, "events": events, "samples": samples, "cycle": cycle}
        if isinstance(law, Law):
            options["weights"] = (law.name, law.to_toml())
        elif law is not None:
            options["law"] = law

        def compute(path, how):
            return _engine.simulate(self._scene, path, how, x, **options)

        return self._do(compute, states_and_numerics, out)

    def _fly(self, law, x0, asked, cycle, out, states_and_numerics):
        from . import _functions

        if cycle or out is not None:
            raise InputError("cycle and out are not for laws of Python")
        named = self._named(states_and_numerics)
        starts, *own = self._scene.simulation()
        options = {
            name: given if asked[name] is None else asked[name]
            for name, given in zip(("time", "events", "samples"), own)
        }
        if x0 is None and not named:
            x0 = [starts[k : k + len(self.states)] for k in range(0, len(starts), len(self.states))]
        x = Places(self, x0, named).x
        time = options["time"]
        if time is None or not 0 < float(time) < float("inf"):
            raise InputError(f"time = {time}: how long to simulate?")
        with self._how(states_and_numerics) as how:
            rtol = 1e-8 if how["rtol"] is None else float(how["rtol"])

            def tell(share):
                if how["progress"] is not None:
                    how["progress"](f"simulated: {100 * share:.0f} %")

            system = _engine.System(self._scene)
            options = {"time": float(time), "events": int(options["events"]), "samples": int(options["samples"])}
            done = _functions.fly(self, system, law, x, options, rtol, tell)
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
        out : path
            The result file; without it there is none that lasts.
        **numerics
            The options of :meth:`using`.
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
        """The series of V and u about the equilibrium, u of a ``degree`` from 1 to 6, as a header of C whose
        names begin with ``name``; also written to the file ``path``."""
        if degree not in range(1, 7):
            raise InputError(f"degree = {degree}: a whole number from 1 to 6")
        text = self._scene.local_to_c(identifier(name), int(degree))
        if path is not None:
            Path(path).write_text(text, encoding="utf-8")
        return text

    def bench(self, *, out=None, trajectories=4096, passes=None, **only) -> xr.DataTree:
        """Speed against error of every backend, precision, method and tolerance on the scene's own
        trajectories, as ``costate bench``: a DataTree with ``speed_error`` and ``host_share``.

        Parameters
        ----------
        out : path
            The result file; without it there is none that lasts.
        trajectories, passes : int
        **only
            ``backend``, ``adapter``, ``precision``, ``method``, ``rtol``: only these (method and rtol may
            be lists).
        """
        from . import _command

        words: list[Any] = ["--trajectories", trajectories]
        for name, given in {**only, "repeats": passes}.items():
            if given is None:
                continue
            if name not in ("backend", "adapter", "precision", "method", "rtol", "repeats"):
                raise TypeError(f"{name} is no option of bench")
            given = [given] if isinstance(given, (str, int, float)) else list(given)
            words += [f"--{name}", ",".join(map(str, given))]
        with _files.Target(out) as target:
            folder = target.folder or os.path.dirname(target.path)
            scene, options = _command.scene_file(self, folder)
            _command.command("bench", scene, *options, *words, "--out", target.path, "--quiet")
            file = target.file()
        return _files.tree(file)

    def mechanism(self, points=None, /, **states) -> dict:
        """The scene's mechanism at states given as for :meth:`solve`: mass matrix, forces, accelerations
        with their derivatives, energies, points, contacts: what ``costate mechanism --json`` prints,
        ``coordinates`` and a dict each of ``states``."""
        import csv

        from . import _command

        with tempfile.TemporaryDirectory(prefix="pycostate-") as folder:
            words: list[Any] = []
            if points is not None or states:
                table = os.path.join(folder, "points.csv")
                with open(table, "w", newline="", encoding="utf-8") as out:
                    writer = csv.writer(out)
                    writer.writerow(self.states)
                    writer.writerows([[repr(float(v)) for v in row] for row in Places(self, points, states).x])
                words = ["--points", table]
            scene, options = _command.scene_file(self, folder)
            return _command.of_json("mechanism", scene, *options, *words)

    def value(self, result) -> Value:
        """V, p and u at any state, interpolated from a result (a file, Dataset or DataTree)."""
        file = _files.file_of(result)
        return Value(file)

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
        with (
            self._how(numerics) as how,
            tempfile.TemporaryDirectory(prefix="pycostate-") as folder,
        ):
            laws, left_out, interrupted = _engine.fit(
                self._scene,
                file.path,
                os.fspath(directory or folder),
                how,
                names=None if names is None else list(names),
                starts=starts,
                seed=seed,
            )
        made = {law.name: Law(law, self) for law in laws}
        if interrupted is not None:
            raise Interrupted("ended before all laws were fitted", made) from interrupted
        if left_out:
            warnings.warn(
                f"no time was left for {', '.join(left_out)}", CostateWarning, stacklevel=2
            )
        return next(iter(made.values())) if len(made) == 1 and not left_out else made
