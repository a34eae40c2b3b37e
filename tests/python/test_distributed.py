"""Work on a Dask cluster of this machine: the same as here, whatever becomes of its workers."""

import os
import random
import signal
import threading

import numpy as np
import pycostate
import pytest
from conftest import ROOT
from pycostate import distributed

dask_distributed = pytest.importorskip("dask.distributed")

LINEAR = """
states = { x = {}, v = {} }
controls = { u = { min = -2, max = 2 } }
dynamics = { x = "v", v = "-x + x^3/6 + u" }
cost = { running = "0.5*(x^2 + v^2 + u^2)" }
equilibrium = { x = 0, v = 0, u = 0 }
region = { x = [-1, 1], v = [-1, 1] }
map = { resolution = { x = 60, v = 50 } }
"""

SMOOTH = """
states = { x = {}, v = {}, y = {}, z = {} }
controls = { a = {}, b = {} }
dynamics = { x = "v", v = "-x + x^3/6 + 0.3*y + a", y = "z", z = "-sin(y) - 0.2*x*y + b" }
cost = { running = "0.5*(x^2 + v^2 + y^2 + z^2 + a^2 + b^2)" }
equilibrium = { x = 0, v = 0, y = 0, z = 0, a = 0, b = 0 }
region = { x = [-1, 1], v = [-1, 1], y = [-1, 1], z = [-1, 1] }
"""


@pytest.fixture(scope="module")
def cluster():
    settings = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None, "silence_logs": "CRITICAL"}
    with dask_distributed.LocalCluster(**settings) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def client(cluster):
    with dask_distributed.Client(cluster) as client:
        yield client


@pytest.fixture(scope="module")
def problem():
    return pycostate.Problem.parse(LINEAR).using(backend="cpu")


@pytest.fixture(scope="module")
def smooth():
    """A map to an error of four states."""
    problem = pycostate.Problem.parse(SMOOTH).using(backend="cpu")
    return problem.having(map={"error": 1e-3, "states": 3000, "check": 30})


@pytest.fixture(scope="module")
def states():
    return np.random.default_rng(3).uniform(-1, 1, (6000, 2))


@pytest.fixture(scope="module")
def here(problem, states):
    return problem.solve(states)


def same(a, b):
    assert dict(a.sizes) == dict(b.sizes)
    assert set(a.variables) == set(b.variables)
    for name in a.variables:
        assert a[name].dims == b[name].dims
        x, y = a[name].values, b[name].values
        assert np.array_equal(x, y, equal_nan=x.dtype.kind == "f"), name
        assert str(a[name].attrs) == str(b[name].attrs), name


def test_states_are_as_here(problem, states, here, client, tmp_path):
    out = tmp_path / "all.h5"
    there = distributed.solve(problem, states, client, shards=5, out=out)
    # It is read when it is wanted.
    assert not isinstance(there["V"].data, np.ndarray) and out.exists()
    same(here, there)
    assert there.attrs["scenario"] == here.attrs["scenario"]
    with pytest.raises(pycostate.InputError, match="shards"):
        distributed.solve(problem, states, client, shards=0)
    with pytest.raises(pycostate.InputError, match="client"):
        distributed.solve(problem, states, "cluster")


def test_states_by_name_keep_their_shape(problem, client):
    given = {"x": np.linspace(-1, 1, 50), "v": np.linspace(-0.9, 0.9, 40)}
    same(problem.solve(**given), distributed.solve(problem, None, client, **given))


def test_a_map_is_as_here(problem, client):
    same(problem.map(), distributed.map(problem, client, shards=3))
    fine = distributed.map(problem, client, counts=40)
    assert fine["V"].shape == (40, 40)
    same(problem.map(counts=40), fine)
    bare = problem.having(map=None)
    same(bare.map(counts=9), distributed.map(bare, client, counts=9))


def test_a_map_to_an_error_is_as_here(client, smooth, tmp_path):
    a, b = tmp_path / "a.h5", tmp_path / "b.h5"
    here = smooth.map(counts=5, out=a)
    work = distributed.map(smooth, client, counts=5, out=b, wait=False)
    there = work.result()
    assert "done" in repr(work) and work._crew.rounds > 1
    same(here, there)
    x = np.random.default_rng(0).uniform(-1, 1, (50, 4))
    one, other = pycostate.Value(a)(x), pycostate.Value(b)(x)
    assert np.isfinite(one).all() and np.array_equal(one, other)
    for wrong in [{"shards": 3}, {"folder": tmp_path}]:
        with pytest.raises(pycostate.InputError, match="round by round"):
            distributed.map(smooth, client, **wrong)
    work = distributed.map(smooth, client, wait=False)
    work.cancel()
    with pytest.raises(pycostate.CostateError, match="given up"):
        work.result()


def test_a_map_that_is_given_up_ends(client):
    """What is searched here, before there are rounds, ends too."""
    pendulum = pycostate.Problem.load(ROOT / "scenarios" / "pendulum.toml").using(backend="cpu")
    work = distributed.map(pendulum, client, error=1e-6, wait=False)
    with pytest.raises(TimeoutError):
        work.result(timeout=0.3)
    work.cancel()
    with pytest.raises(pycostate.CostateError, match="given up"):
        work.result(timeout=20)
    assert "given up" in repr(work)


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_map_to_an_error_outlives_its_workers(cluster, client, smooth):
    """A worker is killed while it solves for the states of a round."""
    here = smooth.map(counts=5)
    work = distributed.map(smooth, client, counts=5, retries=50, wait=False)
    killed, pause = None, threading.Event()
    while killed is None and "done" not in repr(work):
        known = cluster.scheduler.workers
        pids = [w.pid for w in cluster.workers.values() if w.worker_address in known and w.pid]
        if pids and any(future.status == "pending" for future in work.futures):
            killed = pids[0]
            os.kill(killed, signal.SIGKILL)
        pause.wait(0.01)
    same(here, work.result(timeout=240))
    assert killed is not None


def test_flights_are_as_here(client):
    gait = pycostate.Problem.load(ROOT / "scenarios" / "compass_gait.toml")
    first = gait.simulate().simulation["x0"].values[:1]
    x0 = first + 1e-3 * np.random.default_rng(0).normal(size=(7, 4))
    one, other = gait.simulate(None, x0), distributed.simulate(gait, None, x0, client, shards=3)
    assert set(one.children) == set(other.children)
    for name in one.children:
        same(one[name].to_dataset(), other[name].to_dataset())


def test_what_is_wrong_is_told_at_once(problem, states, client):
    with pytest.raises(pycostate.InputError):
        distributed.solve(problem, states[:, :1], client)
    with pytest.raises(pycostate.OutOfTime):
        distributed.solve(problem, states, client, shards=2, time_limit=1e-3)
    work = distributed.solve(problem, states, client, wait=False)
    with pytest.raises(TimeoutError):
        work.result(timeout=1e-3)
    same_v = work.result()["V"].values
    assert np.isfinite(same_v).all() and work.result() is work.result()
    work = distributed.solve(problem, states, client, wait=False)
    work.cancel()
    with pytest.raises(pycostate.CostateError, match="given up"):
        work.result(timeout=20)


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("shared", [False, True])
def test_killed_workers_lose_nothing(problem, states, here, cluster, client, tmp_path, shared):
    """Workers are killed at random while they work."""
    kills, ended = [], threading.Event()
    chance = random.Random(5)

    def kill():
        while not ended.wait(0.05 + 0.3 * chance.random()) and len(kills) < 6:
            # A process that is killed before it is a worker takes its nanny with it.
            known = cluster.scheduler.workers
            pids = [w.pid for w in cluster.workers.values() if w.worker_address in known and w.pid]
            # Nannies of this Dask that are all busy with it at once may give up.
            if len(pids) == 2:
                kills.append(chance.choice(pids))
                try:
                    os.kill(kills[-1], signal.SIGKILL)
                except ProcessLookupError:
                    kills.pop()

    thread = threading.Thread(target=kill)
    thread.start()
    folder = tmp_path / "parts" if shared else None
    try:
        work = distributed.solve(problem, states, client, shards=12, folder=folder, retries=50, wait=False)
        there = work.result(timeout=240)
    finally:
        ended.set()
        thread.join()
    assert kills
    same(here, there)
    if shared:
        # Nothing but whole parts is left, which are not made again.
        names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
        assert names == sorted(f"part-{k}-of-12.h5" for k in range(12))
        same(here, distributed.solve(problem, states, client, shards=12, folder=folder))
