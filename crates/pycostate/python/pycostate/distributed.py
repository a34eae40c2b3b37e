"""Work divided over a Dask cluster: one machine's processes, SSH, Slurm and PBS (dask-jobqueue), Kubernetes.

>>> from dask.distributed import Client
>>> from pycostate import distributed
>>> client = Client(n_workers=4, threads_per_worker=1)
>>> ds = distributed.solve(p, states, client)      # as p.solve(states), to the last bit

The states are cut into blocks that depend on nothing but the states; shards of these are futures of the
cluster. A worker that is lost loses the shards that it was at, and others do them again; with ``folder``, one that
all machines see, what it had done is not done again. The parts are put together here, in a result file, whose
arrays are read as they are wanted.
"""

from __future__ import annotations

import os
import tempfile
import threading
import time
import uuid
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from . import _engine, _files, _options, _toml
from ._places import Places
from ._value import counts_of
from .errors import CostateError, InputError, OutOfTime

__all__ = ["Rounds", "Work", "map", "simulate", "solve"]

#: Seconds between two looks at whether a map is done.
_LOOK = 0.2
#: Shards a worker, unless it is said how many.
_A_WORKER = 4


class Work:
    """Shards on their way: what :func:`solve` and the others return with ``wait=False``."""

    def __init__(self, client, submit, shards: int, retries: int, finish):
        self._client, self._submit, self._finish = client, submit, finish
        self._retries, self._tried = retries, [0] * shards
        self._parts = [None] * shards
        #: The futures of the cluster, one a shard: those that are done again are replaced.
        self.futures = [submit(k, 0) for k in range(shards)]
        self._made, self._is_over = None, False

    def __repr__(self):
        fetched = [part is not None for part in self._parts]
        done = sum(there or f.status == "finished" for there, f in zip(fetched, self.futures))
        return f"<pycostate.distributed.Work: {done} of {len(self.futures)} shards done>"

    def cancel(self) -> None:
        """Gives the work up: :meth:`result` raises :class:`CostateError` then."""
        self._is_over = True
        self._client.cancel(self.futures)

    def result(self, timeout: float | None = None) -> Any:
        """Waits for all shards and puts them together. ``TimeoutError`` after ``timeout`` seconds; the work
        goes on then."""
        if self._made is None:
            self._made = self._finish(self._gathered(timeout))
        return self._made

    def _look(self) -> None:
        if self._is_over:
            raise CostateError("the work was given up")

    def _gathered(self, timeout):
        from dask.distributed import as_completed

        self._look()
        number = {f.key: k for k, f in enumerate(self.futures) if self._parts[k] is None}
        waiting = as_completed([self.futures[k] for k in number.values()], timeout=timeout)
        for future in waiting:
            k = number[future.key]
            failure = self._failure(future)
            if failure is None:
                try:
                    self._parts[k] = future.result()
                    # It is here: no worker needs to have it, nor to make it again.
                    future.release()
                    continue
                # What a lost worker had in its memory alone is lost.
                except Exception as error:
                    failure = error
            self._look()
            if not _is_lost(failure) or self._tried[k] >= self._retries:
                self.cancel()
                if _is_lost(failure):
                    raise CostateError(
                        f"shard {k} of {len(self._parts)} was lost {self._tried[k] + 1} times ({failure}); retries={2 * self._retries} tries longer"
                    ) from failure
                raise failure
            self._tried[k] += 1
            again = self._submit(k, self._tried[k])
            self.futures[k], number[again.key] = again, k
            waiting.add(again)
        return self._parts

    def _failure(self, future):
        if future.status == "error":
            return future.exception()
        if future.status in ("cancelled", "lost"):
            return _Lost(f"its future is {future.status}")
        return None


class Rounds:
    """A map to an error on its way: what :func:`map` returns of it with ``wait=False``."""

    def __init__(self, crew, make):
        self._crew = crew
        self._ended, self._made, self._error = threading.Event(), None, None

        def run():
            try:
                self._made = make()
            except BaseException as error:
                self._error = crew.error or error
            finally:
                self._ended.set()

        self._thread = threading.Thread(target=run, name="pycostate-map", daemon=True)
        self._thread.start()

    def __repr__(self):
        state = "done" if self._ended.is_set() else "under way"
        state = "given up" if self._crew.is_over else state
        return f"<pycostate.distributed.Rounds: {state}, {self._crew.rounds} rounds>"

    @property
    def futures(self) -> list:
        """The futures of the present round."""
        work = self._crew.work_now
        return [] if work is None else work.futures

    def cancel(self) -> None:
        """Gives the map up: it ends soon, and :meth:`result` raises :class:`CostateError`."""
        self._crew.cancel()

    def result(self, timeout: float | None = None) -> Any:
        """Waits for the map. ``TimeoutError`` after ``timeout`` seconds; the work goes on then."""
        try:
            # In short waits: a signal is heard between two.
            end = None if timeout is None else time.monotonic() + timeout
            while not self._ended.wait(_LOOK if end is None else min(_LOOK, max(end - time.monotonic(), 0.0))):
                if end is not None and time.monotonic() >= end:
                    raise TimeoutError(f"the map was not done in {timeout} seconds")
        except KeyboardInterrupt:
            self.cancel()
            raise
        if self._error is not None:
            raise self._error
        return self._made


class _Crew:
    """Who solves for the states of a map: the cluster's workers."""

    def __init__(self, problem, numerics, client, retries):
        self._problem, self._numerics = problem, numerics
        self._client, self._retries = client, retries
        self.is_over = False
        self.rounds, self.work_now, self.error = 0, None, None

    def count(self) -> int:
        return len(self._client.scheduler_info()["workers"])

    def look(self) -> None:
        """The engine looks here, again and again: an exception ends what it does."""
        if self.is_over:
            raise CostateError("the map was given up")

    def cancel(self) -> None:
        self.is_over = True
        if self.work_now is not None:
            self.work_now.cancel()

    def work(self, tasks):
        self.rounds += 1

        def submit(k, tried):
            if self.is_over:
                raise _Lost("the map was given up")
            key = _key("map", k, tried)
            with warnings.catch_warnings():
                # What a round sends is what it needs.
                warnings.filterwarnings("ignore", message="Sending large graph")
                return self._client.submit(
                    _solved, self._problem, self._numerics, tasks[k], pure=False, key=key
                )

        try:
            self.work_now = Work(self._client, submit, len(tasks), self._retries, list)
            return self.work_now.result()
        except BaseException as error:
            self.error = CostateError("the map was given up") if self.is_over else error
            raise


class _Lost(Exception):
    """A future that the cluster has forgotten."""


def _is_lost(error: BaseException) -> bool:
    """Whether a worker has failed, and not the work."""
    if isinstance(error, CostateError):
        return False
    if isinstance(error, (_Lost, ConnectionError, TimeoutError)):
        return True
    # The exceptions of Dask have no module of their own to be imported from in all versions.
    names = {c.__name__ for c in type(error).__mro__}
    return bool(names & {"KilledWorker", "CommClosedError", "CancelledError", "FutureCancelledError", "WorkerProcessDied"})


def solve(
    problem,
    points=None,
    client=None,
    /,
    *,
    shards: int | None = None,
    folder=None,
    out=None,
    retries: int = 10,
    wait: bool = True,
    one_sheet: bool = False,
    trajectories: bool = False,
    samples: int = 200,
    grid_guesses: bool = False,
    **states_and_numerics: Any,
) -> Any:
    """V, p and u at chosen states, as :meth:`pycostate.Problem.solve` finds them, on a cluster.

    Parameters
    ----------
    problem : Problem
    points, **states_and_numerics
        As for :meth:`pycostate.Problem.solve`. ``backend`` and ``adapter`` are the workers'.
    client : dask.distributed.Client
    shards : int
        How many parts to make; without it four a worker. The result does not depend on it.
    folder : path
        A folder that all machines see: parts are written there, and those that are there are not made
        again. Without it they come through the cluster's network.
    out : path
        The result file; without it there is none that lasts.
    retries : int
        How often a shard whose worker is lost is done again.
    wait : bool
        With False a :class:`Work` is returned at once.

    Returns
    -------
    xarray.Dataset
        As :meth:`pycostate.Problem.solve` returns it; its arrays are read from the result file as they are
        wanted. With ``trajectories`` a DataTree.
    """
    named, numerics = problem._named(states_and_numerics, ())
    places = Places(problem, points, named)
    if not len(places.x):
        raise InputError("no states are given")
    options = {
        "one_sheet": _options.yes("one_sheet", one_sheet),
        "samples": _options.whole("samples", samples, 2, 100_000) if trajectories else None,
        "grid_guesses": _options.yes("grid_guesses", grid_guesses),
    }

    def shown(file):
        if trajectories:
            return _files.tree(file)
        return places.shaped(_files.lazy(file, "points"))

    asked = ("solve", np.ascontiguousarray(places.x), options)
    return _begun(problem, asked, numerics, client, (shards, folder, out, retries, wait), shown)


def map(
    problem,
    client=None,
    /,
    *,
    error: float | None = None,
    value_max: float | None = None,
    counts=None,
    shards: int | None = None,
    folder=None,
    out=None,
    retries: int = 10,
    wait: bool = True,
    **numerics: Any,
) -> Any:
    """V over the whole region, on a cluster: the result file's ``/map`` as a Dataset.

    A map to an error (``error``, or ``error`` of the scene's ``[map]``) is refined here, round by round, and
    each round's states are solved for by the cluster: the same map as :meth:`pycostate.Problem.map` makes,
    with the same parameters; its ``shards`` are as many as a round needs, and it has no ``folder``. A grid
    (the scene's ``[map]``, or ``counts`` along each axis in its place) is divided into shards. The other
    parameters are those of :func:`solve`.
    """
    own = dict(_toml.loads(problem.text).get("map", {}))
    if error is not None or "error" in own:
        if shards is not None or folder is not None:
            raise InputError("shards and folder are of grids: a map to an error is divided round by round")
        retries = _options.whole("retries", retries, 0, 10_000)
        crew = _Crew(problem, numerics, _client(client), retries)
        work = Rounds(crew, lambda: problem._mapped(error, value_max, counts, out, numerics, crew))
        return work.result() if wait else work
    if not (own or counts):
        raise InputError("what grid? distributed.map(p, client, counts=...), or the problem's [map]")
    if value_max is not None:
        own["value_max"] = _options.number("value_max", value_max)
    if counts is not None:
        own["resolution"] = dict(zip(problem.states, counts_of(problem.states, counts)))
    problem = problem.having(map=own)
    asked = ("map", None, {})
    return _begun(problem, asked, numerics, client, (shards, folder, out, retries, wait), _map_of)


def _map_of(file):
    return _files.lazy(file, "map")


def simulate(
    problem,
    law=None,
    x0=None,
    client=None,
    /,
    *,
    shards: int | None = None,
    retries: int = 10,
    wait: bool = True,
    **options: Any,
) -> Any:
    """Flights forward in time, as :meth:`pycostate.Problem.simulate` makes them, on a cluster: the same
    DataTree. ``law`` is one of ours, a name, or a function that can be pickled; ``options`` are those of
    :meth:`pycostate.Problem.simulate` and the other parameters those of :func:`solve`.
    """
    import xarray as xr

    client = _client(client)
    x = np.ascontiguousarray(Places(problem, x0, {}).x)
    if not len(x):
        raise InputError("no states are given")
    shards = min(_count(client, shards), len(x))
    own = [np.flatnonzero(_owner(len(x), shards) == k) for k in range(shards)]

    def submit(k, tried):
        return client.submit(
            _flights, problem, law, x[own[k]], options, pure=False, key=_key("simulate", k, tried)
        )

    def finish(parts):
        trees = [xr.DataTree.from_dict(part) for part in parts]
        return _flights_of(trees, own)

    work = Work(client, submit, shards, retries, finish)
    return work.result() if wait else work


# What runs on a worker.

#: Workers of maps, by what they are of: a process makes one of each, once.
_workers: dict[str, Any] = {}
_MOST_WORKERS = 4
_making = threading.Lock()


def _solved(problem, numerics, task):
    """States that a map asks for."""
    _threads()
    what = repr((problem.text, problem._scene.set, problem._numerics, numerics))
    with _making:
        worker = _workers.get(what)
        if worker is None:
            with problem._how({**numerics, "time_limit": None, "progress": None}) as how:
                worker = _engine.MapWorker(problem._scene, how)
            while len(_workers) >= _MOST_WORKERS:
                _workers.pop(next(iter(_workers)))
            _workers[what] = worker
    return worker.work(task)


def _threads() -> None:
    """As many threads as the worker has, unless it is said otherwise."""
    try:
        from dask.distributed import get_worker

        count = get_worker().state.nthreads
    except (ImportError, ValueError):
        return
    os.environ.setdefault("RAYON_NUM_THREADS", str(count))


def _part(problem, what, x, options, numerics, shard, folder):
    """A shard of states: its file's path, or what is in the file."""
    _threads()
    # What came through the network may begin anywhere in memory.
    x = None if x is None else np.require(x, float, ["C", "A"])

    def compute(path):
        with problem._how(numerics) as how:
            return _engine.run(problem._scene, what, path, how, x, shard=shard, **options)

    if folder is not None:
        path = os.path.join(folder, "part-{}-of-{}.h5".format(*shard))
        with warnings.catch_warnings():
            # That is what the folder is for.
            warnings.filterwarnings("ignore", message=".*is finished: nothing is left to do")
            written = compute(path)
        return _whole(written) or written[0]
    with tempfile.TemporaryDirectory(prefix="pycostate-") as own:
        written = compute(os.path.join(own, "part.h5"))
        _whole(written)
        return Path(written[0]).read_bytes()


def _whole(written) -> None:
    """Refuses what was ended before it was done."""
    _, _, stopped, interrupted = written
    if interrupted is not None:
        raise interrupted
    if stopped:
        raise OutOfTime("the time limit came before a shard was done")


def _flights(problem, law, x, options):
    """Some flights: the groups of their result."""
    _threads()
    x = np.require(x, float, ["C", "A"])
    made = problem.simulate(law, x, **{"progress": None, **options})
    groups = {node.path: node.to_dataset().load() for node in made.subtree}
    for group in groups.values():
        # The file that they are of is the worker's.
        group.encoding = {}
    return groups


# What runs here.


def _client(client):
    if client is None:
        try:
            from dask.distributed import default_client
        except ModuleNotFoundError:
            raise CostateError("this needs Dask: pip install pycostate[distributed]") from None
        try:
            return default_client()
        except ValueError:
            raise InputError("which cluster? dask.distributed.Client(...) makes a client of one") from None
    if not hasattr(client, "submit"):
        raise InputError(f"client = {client!r}: a dask.distributed.Client is needed")
    return client


def _count(client, shards):
    if shards is None:
        return max(_A_WORKER * len(client.scheduler_info()["workers"]), _A_WORKER)
    return _options.whole("shards", shards, 1, 1_000_000)


def _owner(units: int, of: int):
    return np.asarray(_engine.shard_owner(units, of))


def _key(what, k, tried):
    again = f"-{tried}" if tried else ""
    return f"costate-{what}-{uuid.uuid4().hex[:8]}-{k}{again}"


def _kept(x):
    return x


def _begun(problem, asked, numerics, client, how, shown):
    what, x, options = asked
    shards, folder, out, retries, wait = how
    client = _client(client)
    shards = _count(client, shards)
    if folder is not None:
        folder = os.path.abspath(_options.path("folder", folder))
        os.makedirs(folder, exist_ok=True)
    out = _options.out(out)
    # Once on its way, and made again where it is lost.
    states = None if x is None else client.submit(_kept, x, pure=False, key=_key("states", 0, 0))

    def submit(k, tried):
        shard = (k, shards)
        return client.submit(
            _part, problem, what, states, options, numerics, shard, folder, pure=False, key=_key(what, k, tried)
        )

    def finish(parts):
        nonlocal states
        states = None
        with _files.Target(out) as target, tempfile.TemporaryDirectory(prefix="pycostate-") as own:
            paths = []
            for k, part in enumerate(parts):
                if isinstance(part, bytes):
                    path = os.path.join(own, f"part-{k}.h5")
                    Path(path).write_bytes(part)
                    parts[k], part = None, path
                paths.append(part)
            path, _, _ = _engine.merge(paths, target.path, False)
            file = target.file(path)
        return shown(file)

    work = Work(client, submit, shards, _options.whole("retries", retries, 0, 10_000), finish)
    return work.result() if wait else work


def _flights_of(trees, own):
    """The flights of all shards as one DataTree, in the order of the states."""
    import xarray as xr

    rows = {"simulation": "flight", "cycles": "cycle"}
    children = {"simulation_events": "jump", "simulation_samples": "sample"}
    groups = {"/": trees[0].to_dataset()}
    for name in [*rows, *children]:
        there = [(k, tree[name].to_dataset()) for k, tree in enumerate(trees) if name in tree.children]
        if not there:
            continue
        along = rows.get(name) or children[name]
        if name in rows:
            order = np.concatenate([own[k] for k, _ in there])
        else:
            there = [(k, d.assign(flight=d["flight"].copy(data=own[k][d["flight"].values].astype("int32")))) for k, d in there]
            order = np.concatenate([d["flight"].values for _, d in there])
        whole = xr.concat(
            [d.drop_vars(along, errors="ignore") for _, d in there],
            along,
            data_vars="minimal",
            coords="minimal",
            compat="override",
            join="override",
            combine_attrs="override",
        )
        whole = whole.isel({along: np.argsort(order, kind="stable")})
        first = there[0][1]
        if along in first.variables:
            numbers = xr.Variable((along,), np.arange(whole.sizes[along]), first[along].attrs)
            whole = whole.assign_coords({along: numbers})
        groups[name] = whole
    return xr.DataTree.from_dict(groups)
