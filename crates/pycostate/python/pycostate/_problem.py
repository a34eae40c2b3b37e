"""Problems, values and laws: what users see of the engine."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from . import _engine, _files, _options, _toml
from ._check import Check
from ._law import Law
from ._places import Places, identifier
from ._value import Value, counts_of, refuse_axes
from .errors import InputError, Interrupted, OutOfTime, warn

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    import xarray as xr

    if sys.version_info >= (3, 11):
        from typing import Unpack
    else:
        from typing_extensions import Unpack

    from ._options import Numerics

    Path_ = str | os.PathLike[str]
    Result = Path_ | xr.Dataset | xr.DataTree | _files.ResultFile
    Names = str | Iterable[str]

#: Sections that say which problem it is; the others say what is asked of it.
_ESSENCE = (
    "states",
    "controls",
    "disturbances",
    "dynamics",
    "mechanism",
    "definitions",
    "cost",
    "equilibrium",
    "guards",
)


def _assignments(values: Mapping) -> list[tuple[str, str]]:
    def text(name, value):
        if isinstance(value, str):
            return value
        try:
            return repr(float(value))
        except (TypeError, ValueError, OverflowError):
            raise InputError(
                f"parameter {name} = {value!r}: a number, or an expression of earlier parameters as a text"
            ) from None

    return [(name, text(name, value)) for name, value in values.items()]


def _table(what: str, value) -> dict:
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise InputError(f"{what} = {value!r}: a dict by name")
    return dict(value)


def _declared(what: str, value):
    """Names with what is said of each."""
    if value is None:
        return None
    if isinstance(value, str):
        value = [value]
    if not isinstance(value, Mapping):
        try:
            value = dict.fromkeys(value)
        except TypeError:
            raise InputError(f"{what} = {value!r}: names, or a dict by name") from None
    return {name: {} if said is None else said for name, said in value.items()}


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
        cost = _table("cost", sections.pop("cost", None))
        own = {"running": running, "terminal": terminal, "final_time": final_time}
        for key, value in own.items():
            if value is not None and cost.setdefault(key, value) != value:
                raise InputError(f"{key} is given twice, also in cost")
        if isinstance(controls, Mapping):
            # Bounds alone.
            controls = {
                name: dict(zip(("min", "max"), said)) if isinstance(said, tuple) and len(said) == 2 else said
                for name, said in controls.items()
            }
        if "disturbances" in sections:
            sections["disturbances"] = _declared("disturbances", sections["disturbances"])
        plain = {k: v for k, v in sections.items() if not isinstance(v, Mapping)}
        rest = {k: v for k, v in sections.items() if isinstance(v, Mapping)}
        parts = {
            "states": _declared("states", states),
            "controls": _declared("controls", controls),
            "dynamics": dynamics,
            "cost": cost or None,
        }
        parts = {k: v for k, v in parts.items() if v is not None}
        text = _toml.dumps({**plain, **parts, **rest})
        self._begin(_engine.Scene.parse(text, _options.path("name", name), []), dict(_options.NUMERICS))

    def _begin(self, scene, numerics):
        self._scene = scene
        self._numerics = numerics

    @classmethod
    def _of(cls, scene, numerics=None):
        made = cls.__new__(cls)
        made._begin(scene, dict(numerics or _options.NUMERICS))
        return made

    @classmethod
    def load(cls, path: Path_, /, **set: float | str) -> Problem:
        """Reads a scene's file, ``path``; ``set`` are parameters in place of the file's (numbers, or
        expressions of earlier parameters)."""
        return cls._of(_engine.Scene.load(_options.path("path", path), _assignments(set)))

    @classmethod
    def parse(cls, text: str, /, name: str = "scene.toml", **set: float | str) -> Problem:
        """Reads a scene's ``text``, with ``set`` as in :meth:`load`; ``name`` is what errors call it."""
        return cls._of(_engine.Scene.parse(text, name, _assignments(set)))

    @classmethod
    def of(cls, result: Result) -> Problem:
        """The problem that a result is of: a file's path, a Dataset or a DataTree."""
        return cls._of(_engine.scene_of_file(_files.file_of(result).path))

    # Other problems.

    def set(self, /, **values: float | str) -> Problem:
        """The same with other values of its parameters; what follows from them follows."""
        given = dict(self._scene.set)
        given.update(_assignments(values))
        scene = _engine.Scene.parse(
            self._scene.text, self._scene.file_name, list(given.items())
        )
        return self._of(scene, self._numerics)

    def having(self, **sections: Any) -> Problem:
        """The same with other sections: a dict is merged into the section, None takes it away.

        >>> p.having(map={"error": 1e-3}, homotopy=None)
        """
        text = _toml.dumps(_toml.merged(_toml.loads(self._scene.text), sections))
        # What is given here is newer than what was set.
        newer = sections.get("parameters", {})
        kept = [(k, v) for k, v in self._scene.set if newer is not None and k not in newer]
        scene = _engine.Scene.parse(text, self._scene.file_name, kept)
        return self._of(scene, self._numerics)

    def using(self, **numerics: Unpack[Numerics]) -> Problem:
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
        return self._of(self._scene, {**self._numerics, **_options.known(numerics)})

    # What it is.

    @property
    def text(self) -> str:
        """The scene, as TOML; parameters that were :meth:`set` are not in it (:meth:`save` writes them)."""
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

    def save(self, path: Path_) -> None:
        """Writes the scene's file, ``path``; parameters are what they were :meth:`set` to."""
        _files.write(path, self._full_text())

    def _full_text(self) -> str:
        """The scene with what was set."""
        if not self._scene.set:
            return self.text
        tree = _toml.loads(self.text)
        for name, value in self._scene.set:
            try:
                tree["parameters"][name] = float(value)
            except ValueError:
                tree["parameters"][name] = value
        return _toml.dumps(tree)

    def __reduce__(self):
        scene = self._scene
        numerics = {k: v for k, v in self._numerics.items() if k != "progress"}
        return _restored, (scene.text, scene.file_name, scene.set, numerics)

    def __deepcopy__(self, memo):
        return self

    def __repr__(self):
        return f"<pycostate.Problem {self.title!r}: states {', '.join(self.states)}; controls {', '.join(self.controls)}>"

    def _repr_html_(self):
        from html import escape

        return f"<b>{escape(self.title)}</b><pre>{escape(self.text)}</pre>"

    def check(self) -> Check:
        """What follows from the problem: equations, the local solution, guards."""
        text, summary, notes = self._scene.check()
        for note in notes:
            warn(note)
        return Check(text, json.loads(summary))

    # What it computes.

    def _named(self, given, taken=()) -> tuple[dict, dict]:
        """States that are given by name, and options; ``taken`` are options that a state is called like."""
        for name, value in taken:
            if name in self.states and value:
                raise InputError(f"{name} is a state and an option: give the states as points")
        named = {k: v for k, v in given.items() if k in self.states}
        rest = {k: v for k, v in given.items() if k not in named}
        return named, _options.known(rest, self.states)

    def _how(self, numerics):
        """How to compute: the problem's options with those of a call."""
        return _options.how({**self._numerics, **_options.known(numerics)})

    def _do(self, compute, numerics, out, group=None):
        """Computes into a file; a group of it as a Dataset, or all as a DataTree."""
        with self._how(numerics) as how, _files.Target(_options.out(out)) as target:
            path, _, stopped, interrupted = compute(target.path, how)
            file = target.file(path)
        if interrupted is not None and not isinstance(interrupted, KeyboardInterrupt):
            raise interrupted
        made = None
        if group is None:
            made = _files.tree(file)
        elif _files.has(file, group):
            made = _files.dataset(file, group)
        if interrupted is not None:
            raise Interrupted(
                "ended before all was done; what was done by then is in `result` of this exception",
                made,
            ) from interrupted
        if stopped:
            if made is None:
                raise OutOfTime("the time limit came before there was anything to show")
            warn("ended by the time limit before all was done")
        return _files.root(file) if made is None else made

    def _run(self, what, x, options, numerics, out, group):
        def compute(path, how):
            return _engine.run(self._scene, what, path, how, x, **options)

        return self._do(compute, numerics, out, group)

    def run(
        self,
        *,
        out: Path_ | None = None,
        keep: Literal["all", "values", "nothing"] = "all",
        grid_guesses: bool = False,
        **numerics: Unpack[Numerics],
    ) -> xr.DataTree:
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
        options = {"kept": keep, "grid_guesses": _options.yes("grid_guesses", grid_guesses)}
        return self._run("run", None, options, numerics, out, None)

    def sweep(
        self,
        *,
        out: Path_ | None = None,
        keep: Literal["all", "values", "nothing"] = "all",
        **numerics: Unpack[Numerics],
    ) -> xr.Dataset:
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

    def homotopy(
        self, *, out: Path_ | None = None, grid_guesses: bool = False, **numerics: Unpack[Numerics]
    ) -> xr.DataTree:
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
        options = {"grid_guesses": _options.yes("grid_guesses", grid_guesses)}
        return self._run("homotopy", None, options, numerics, out, None)

    def solve(
        self,
        points=None,
        /,
        *,
        out: Path_ | None = None,
        one_sheet: bool = False,
        trajectories: bool = False,
        samples: int = 200,
        grid_guesses: bool = False,
        **states_and_numerics: Any,
    ) -> Any:
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
        taken = (("out", out), ("samples", samples != 200), ("trajectories", trajectories))
        named, numerics = self._named(states_and_numerics, () if points is not None else taken)
        places = Places(self, points, named)
        if not len(places.x):
            raise InputError("no states are given")
        options = {
            "one_sheet": _options.yes("one_sheet", one_sheet),
            "samples": _options.whole("samples", samples, 2, 100_000) if trajectories else None,
            "grid_guesses": _options.yes("grid_guesses", grid_guesses),
        }
        group = None if trajectories else "points"
        try:
            made = self._run("solve", places.x, options, numerics, out, group)
        except Interrupted as stopped:
            if group is not None and stopped.result is not None:
                stopped.result = places.shaped(stopped.result)
            raise
        return made if trajectories or made is None else places.shaped(made)

    def map(
        self,
        error: float | None = None,
        *,
        value_max: float | None = None,
        counts: int | Sequence[int] | Mapping[str, int] | None = None,
        out: Path_ | None = None,
        **numerics: Unpack[Numerics],
    ) -> xr.Dataset:
        """V over the whole region.

        Parameters
        ----------
        error : float
            The largest error of V wanted, as a share of V (near 0, of a floor: ``floor`` in the result's
            attributes): the map is then in pieces, which :meth:`value` evaluates anywhere. Where it is not
            met is counted (``share_unmet``). Without it the scene's ``[map]`` counts.
        value_max : float
            V up to which states count.
        counts : int or dict
            Points along each axis of the grid that is returned. Of a map to an error the default is 101 in
            one and two states, and fewer in more; where the scene's ``[map]`` asks for a grid alone, V is
            solved for at this one in its place.
        out : path
            The result file; without it there is none that lasts.
        **numerics
            The options of :meth:`using`.

        Returns
        -------
        xarray.Dataset
            The result file's ``/map``: V, p, u over the states' axes (on a finite horizon at t = 0), with
            errors where the map is in pieces.
        """
        return self._mapped(error, value_max, counts, out, numerics, None)

    def _mapped(self, error, value_max, counts, out, numerics, workers):
        problem = self
        counted = counts_of(self.states, counts)
        refuse_axes(self)
        changes: dict[str, Any] = {"homotopy": None, "feedback": None, "closed_loop": None}
        if error is not None or value_max is not None:
            own = {
                "error": None if error is None else _options.number("error", error, low=0.0),
                "value_max": None if value_max is None else _options.number("value_max", value_max),
            }
            changes["map"] = {k: v for k, v in own.items() if v is not None}
        there = _toml.loads(self.text)
        if "map" not in there and "map" not in changes and counts is None:
            raise InputError("how exact a map? p.map(error=1e-3), p.map(counts=...), or the problem's [map]")
        if counts is not None and error is None and "error" not in there.get("map", {}):
            changes.setdefault("map", {})["resolution"] = dict(zip(self.states, counted))
        changes = {k: v for k, v in changes.items() if v is not None or k in there}
        if changes:
            problem = self.having(**changes)

        def shown(tree):
            file = _files.file_of(tree)
            if _files.has(file, "map_pieces"):
                return Value(file).grid(counts=counts)
            return _files.dataset(file, "map") if _files.has(file, "map") else None

        try:
            made = shown(problem._run("homotopy", None, {"workers": workers}, numerics, out, None))
        except Interrupted as stopped:
            stopped.result = None if stopped.result is None else shown(stopped.result)
            raise
        if made is None:
            raise OutOfTime("the time limit came before there was a map")
        return made

    def study(self, *, out: Path_ | None = None, **numerics: Unpack[Numerics]) -> xr.Dataset:
        """The scene's ``[study]``: ``/study`` as a Dataset, one row a variant. ``out`` is the result file;
        ``numerics`` are the options of :meth:`using`."""

        def compute(path, how):
            return _engine.study(self._scene, path, how)

        return self._do(compute, numerics, out, "study")

    def attenuation(self, *, out: Path_ | None = None, **numerics: Unpack[Numerics]) -> xr.DataTree:
        """The smallest levels of attenuation of the scene's ``[attenuation]``, as a DataTree. ``out`` is the
        result file; ``numerics`` are the options of :meth:`using`."""

        def compute(path, how):
            return _engine.attenuation(self._scene, path, how)

        return self._do(compute, numerics, out)

    def simulate(
        self,
        law: Law | Value | str | Callable[..., Any] | None = None,
        x0: Any = None,
        /,
        *,
        time: float | None = None,
        events: int | None = None,
        samples: int | None = None,
        cycle: int | None = None,
        out: Path_ | None = None,
        **states_and_numerics: Any,
    ) -> xr.DataTree:
        """Flights forward in time, with the scene's events.

        Parameters
        ----------
        law : Law, str or callable
            What controls: a fitted law, the name of one of the scene's (``"lqr"``), or any function of
            states (N, states) that gives controls (N, controls), such as ``p.value(m).u``; one that has a
            parameter ``t`` is given times (N,), too. None: the scene's, or controls as they are at the
            equilibrium. A function is called by Python, a stage of a step for all flights at once (dopri5,
            f64, ``rtol`` 1e-8); controls are kept within their bounds.
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
            The result file; without it there is none that lasts.

        Returns
        -------
        xarray.DataTree
            ``simulation``, ``simulation_events``, ``simulation_samples``, and ``cycles`` where orbits
            were looked for. Under a function ``simulation`` has J, too: the running cost until the end, and
            that at the final time where ``time`` is the final time.
        """
        if isinstance(law, Value):
            law = law.u
        asked = {
            "time": None if time is None else _options.number("time", time, low=0.0),
            "events": None if events is None else _options.whole("events", events, 1, 1_000_000),
            "samples": None if samples is None else _options.whole("samples", samples, 0, 100_000),
        }
        cycle = None if cycle is None else _options.whole("cycle", cycle, 0, 1000)
        taken = [("out", out), ("cycle", cycle), *asked.items()]
        named, numerics = self._named(states_and_numerics, () if x0 is not None else taken)
        x = Places(self, x0, named).x if x0 is not None or named else None
        if x is not None and not len(x):
            raise InputError("no states are given")
        if callable(law) and not isinstance(law, Law):
            return self._fly(law, x, asked, cycle, out, numerics)
        options: dict[str, Any] = {**asked, "cycle": cycle}
        if options["time"] is None and self._scene.simulation()[1] is None:
            raise InputError("how long to simulate? time=, or the problem's [simulation] time")
        if isinstance(law, Law):
            options["weights"] = (law.name, law.to_toml())
        elif law == "map":
            raise InputError("the law of a map is that of its value: p.simulate(p.value(result), x0)")
        elif isinstance(law, str):
            options["law"] = law
        elif law is not None:
            raise InputError("the law comes first, then the states: p.simulate(None, x0) for controls that are held")

        def compute(path, how):
            return _engine.simulate(self._scene, path, how, x, **options)

        return self._do(compute, numerics, out)

    def _fly(self, law, x, asked, cycle, out, numerics):
        import numpy as np

        from . import _functions

        if cycle:
            raise InputError("cycle: no orbits are looked for under a law of Python")
        for name in ("backend", "adapter", "precision", "method"):
            if numerics.get(name) is not None:
                raise InputError(f"{name}: a law of Python is flown in Python, by dopri5 in f64")
        starts, *own = self._scene.simulation()
        options = {
            name: given if asked[name] is None else asked[name]
            for name, given in zip(("time", "events", "samples"), own)
        }
        if options["time"] is None:
            raise InputError("how long to simulate? time=, or the problem's [simulation] time")
        if x is None:
            x = np.array(starts, dtype=float).reshape(-1, len(self.states))
        with self._how(numerics) as how, _files.Target(_options.out(out)) as target:
            system = _engine.System(self._scene)
            done = _functions.fly(self, system, law, x, options, how)
            file = target.file(system.write(target.path, done))
        return _files.tree(file)

    def evaluate(
        self,
        result: Result | None = None,
        *,
        laws: Names | None = None,
        added: Law | Iterable[Law] = (),
        random: int | None = None,
        solve: bool = False,
        out: Path_ | None = None,
        **numerics: Unpack[Numerics],
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
        stored = None if result is None else self._own(result)
        added = [added] if isinstance(added, Law) else list(added)
        for law in added:
            if not isinstance(law, Law):
                raise InputError("added: laws of costate; a function of Python is flown by p.simulate(function, x0), which tells its J")
        options = {
            "laws": None if laws is None else _options.words(laws),
            "weights": [(law.name, law.to_toml()) for law in added],
            "random": None if random is None else _options.whole("random", random, 1),
            "solve": _options.yes("solve", solve),
        }

        def compute(path, how):
            given = None if stored is None else stored.path
            return _engine.evaluate(self._scene, path, how, given, **options)

        return self._do(compute, numerics, out)

    def local_to_c(self, path: Path_ | None = None, *, degree: int = 3, name: str = "local") -> str:
        """The series of V and u about the equilibrium, u of a ``degree`` from 1 to 6, as a header of C whose
        names begin with ``name``; also written to the file ``path``."""
        text = self._scene.local_to_c(identifier(name), _options.whole("degree", degree, 1, 6))
        return _files.write(path, text)

    def bench(
        self, *, out: Path_ | None = None, trajectories: int = 4096, passes: int | None = None, **only: Any
    ) -> xr.DataTree:
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
        with (
            _files.Target(_options.out(out)) as target,
            tempfile.TemporaryDirectory(dir=_files.folder()) as folder,
        ):
            scene, options = _command.scene_file(self, folder)
            _command.spoken("bench", scene, *options, *words, "--out", target.path, "--quiet")
            file = target.file()
        return _files.tree(file)

    def mechanism(self, points: Any = None, /, **states: Any) -> dict[str, Any]:
        """The scene's mechanism at states given as for :meth:`solve`: mass matrix, forces, accelerations
        with their derivatives, energies, points, contacts: what ``costate mechanism --json`` prints,
        ``coordinates`` and a dict each of ``states``."""
        import csv

        from . import _command

        with tempfile.TemporaryDirectory(dir=_files.folder()) as folder:
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

    def value(self, result: Result) -> Value:
        """V, p and u at any state, interpolated from a result (a file, Dataset or DataTree)."""
        return Value(self._own(result, is_told=True))

    def _own(self, result, *, is_told=False) -> _files.ResultFile:
        """The file of a result, which is to have this problem's states and controls."""
        file = _files.file_of(result)
        other = Problem.of(file)
        for what in ("states", "controls"):
            mine, its = getattr(self, what), getattr(other, what)
            if mine != its:
                raise InputError(
                    f"this is a result of another problem: its {what} are {', '.join(its)}, not {', '.join(mine)}"
                )
        if is_told and self._essence() != other._essence():
            warn("this is a result of another problem (other parameters, equations or cost), and V is that of it")
        return file

    def _essence(self) -> dict:
        tree = _toml.loads(self.text)
        return {**{k: tree.get(k) for k in _ESSENCE}, "parameters": self.parameters}

    def fit(
        self,
        result: Result,
        *,
        names: Names | None = None,
        starts: int | None = None,
        seed: int | None = None,
        directory: Path_ | None = None,
        **numerics: Any,
    ) -> Any:
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
        file = self._own(result)
        there = self._scene.laws
        if not there:
            raise InputError('the problem has no [feedback]: p.having(feedback={"NAME": {"fit": "u", ...}}) gives it one')
        names = None if names is None else _options.words(names)
        for name in names or ():
            if name not in there:
                raise InputError(f"there is no law {name} in [feedback] ({', '.join(there)})")
        options: dict[str, Any] = {
            "names": names,
            "starts": None if starts is None else _options.whole("starts", starts, 1, 1_000_000),
            "seed": None if seed is None else _options.whole("seed", seed, 0, 2**64 - 1),
        }
        with (
            self._how(numerics) as how,
            tempfile.TemporaryDirectory(dir=_files.folder()) as folder,
        ):
            laws, left_out, interrupted = _engine.fit(
                self._scene, file.path, os.path.abspath(directory or folder), how, **options
            )
        made = {law.name: Law(law, self) for law in laws}
        if interrupted is not None:
            raise Interrupted("ended before all laws were fitted", made) from interrupted
        if left_out:
            warn(f"no time was left for {', '.join(left_out)}")
        return next(iter(made.values())) if len(made) == 1 and not left_out else made


def _restored(text, name, set, numerics):
    """A problem that was pickled."""
    scene = _engine.Scene.parse(text, name, set)
    return Problem._of(scene, {**_options.NUMERICS, **numerics})
