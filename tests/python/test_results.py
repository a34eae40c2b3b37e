"""Results: labelled arrays with the file's names, and the numbers of the command line."""

import gc
import json
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import pycostate
import pytest
import xarray as xr

SQRT2 = np.sqrt(2.0)


def exact(x, v):
    return 0.5 * (SQRT2 * (x**2 + v**2) + 2 * x * v)


def test_solve_by_name(double_integrator):
    x = np.linspace(-0.8, 0.8, 5)
    ds = double_integrator.solve(x=x, v=[0.1, -0.2])
    assert ds.V.dims == ("x", "v") and ds.p.dims == ("x", "v", "state")
    np.testing.assert_allclose(ds.V, exact(ds.x, ds.v), atol=1e-8)
    assert ds.x.attrs["units"] == "m" and ds.V.attrs["long_name"]
    one = ds.sel(x=0.8, v=0.1)
    assert one.V.item() == pytest.approx(exact(0.8, 0.1), abs=1e-8)
    np.testing.assert_allclose(ds.p.sel(state="v"), ds.x + SQRT2 * ds.v, atol=1e-7)
    # A number is a coordinate without a dimension.
    ds = double_integrator.solve(x=x, v=0.3)
    assert ds.V.dims == ("x",) and ds.v.item() == 0.3


def test_solve_points_of_any_kind(double_integrator):
    points = np.array([[0.5, 0.2], [-0.3, 0.1], [0.5, 0.2]])
    want = exact(points[:, 0], points[:, 1])
    for given in (
        points,
        points.tolist(),
        np.asfortranarray(points),
        points[::-1][::-1],
        points.astype(np.float32),
    ):
        ds = double_integrator.solve(given)
        assert ds.sizes["point"] == 3
        np.testing.assert_allclose(ds.V, want, atol=1e-6)
    integers = double_integrator.solve(np.array([[1, 0]]))
    assert integers.V.item() == pytest.approx(exact(1, 0), abs=1e-8)
    # Over the dimensions of a Dataset.
    given = xr.Dataset(
        {"x": ("i", [0.1, 0.2, 0.3]), "v": (("i", "j"), np.full((3, 2), 0.1))}
    )
    ds = double_integrator.solve(given)
    assert ds.V.dims == ("i", "j")
    np.testing.assert_allclose(ds.V, exact(given.x, given.v), atol=1e-8)


def test_trajectories_of_solved_states(double_integrator):
    tree = double_integrator.solve(x=[0.5, -0.5], v=0.0, trajectories=True, samples=20)
    assert set(tree.children) >= {"points", "trajectories"}
    assert tree["trajectories"].sizes["sample"] == 20


def test_sweep_and_run(double_integrator, tmp_path):
    p = double_integrator.having(shoot_out={"value_max": 0.5, "spacing": 0.2, "samples": 10})
    ds = p.sweep()
    inside = ds.V.notnull()
    x, v = ds.x.sel(state="x"), ds.x.sel(state="v")
    np.testing.assert_allclose(ds.V.where(inside), exact(x, v).where(inside), atol=1e-6)
    out = tmp_path / "di.h5"
    tree = p.run(out=out)
    assert "trajectories" in tree.children and out.exists()
    # The same names and numbers as xarray reads from the file.
    stored = xr.open_dataset(out, group="trajectories", engine="h5netcdf")
    assert set(stored.variables) == set(tree["trajectories"].variables)
    np.testing.assert_array_equal(stored.V, tree["trajectories"].V)
    again = pycostate.open(out)
    xr.testing.assert_identical(again["trajectories"].to_dataset(), tree["trajectories"].to_dataset())
    assert json.loads(again.attrs["summary"])["trajectories"] == ds.sizes["trajectory"]


def test_map_and_value(double_integrator):
    m = double_integrator.map(error=1e-4)
    assert m.V.dims == ("x", "v") and (m.V_error.max() < 1e-4)
    np.testing.assert_allclose(m.V, exact(m.x, m.v), atol=1e-4)
    v = double_integrator.value(m)
    rng = np.random.default_rng(1)
    x = rng.uniform(-0.9, 0.9, (7, 3, 2))
    np.testing.assert_allclose(v(x), exact(x[..., 0], x[..., 1]), atol=1e-4)
    np.testing.assert_allclose(v.p(x)[..., 1], x[..., 0] + SQRT2 * x[..., 1], atol=1e-3)
    np.testing.assert_allclose(v.u(x)[..., 0], -v.p(x)[..., 1], atol=1e-12)
    assert v(x).shape == (7, 3) and v.error(x).shape == (7, 3)
    assert np.all(v.error(x) < 1e-4)
    assert v([0.5, 0.2]) == v(x=0.5, v=0.2)
    assert np.ndim(v([0.5, 0.2])) == 0
    assert v(x=[0.1, 0.2], v=0.0).shape == (2,)
    assert np.isnan(v([5.0, 5.0])) and v.status([5.0, 5.0]) != "interpolated"
    assert m.V.sel(x=0.5, v=0.2, method="nearest") == pytest.approx(exact(0.5, 0.2), abs=0.05)
    at = v.at(x=[0.1, 0.2], v=0.0)
    assert at.V.dims == ("x",) and "V_error" in at
    grid = v.grid(counts={"x": 5, "v": 3})
    assert grid.V.shape == (5, 3)


def test_a_law_is_fitted_and_flies(double_integrator, tmp_path):
    p = double_integrator.having(
        shoot_out={"value_max": 1.0, "spacing": 0.2, "samples": 20},
        feedback={"small": {"fit": "u", "hidden": [3], "iterations": 30, "starts": 2}},
    )
    law = p.fit(p.sweep())
    assert law.name == "small" and law.outputs == ("u",)
    x = np.random.default_rng(2).uniform(-0.4, 0.4, (50, 2))
    np.testing.assert_allclose(law(x)[:, 0], -x[:, 0] - SQRT2 * x[:, 1], atol=0.05)
    assert "small_" in law.to_c() and law.to_onnx()[:1]
    law.save(tmp_path / "small.toml")
    again = pycostate.load_law(tmp_path / "small.toml", p)
    np.testing.assert_allclose(again(x), law(x), rtol=1e-12)
    with pytest.raises(pycostate.InputError, match="onnx"):
        law.save(tmp_path / "small.txt")
    flown = p.simulate(law, [[0.3, 0.0], [-0.2, 0.1]], time=12.0)
    assert flown["simulation"].sizes["flight"] == 2
    assert abs(flown["simulation"].x_end).max() < 0.02


def test_simulate_with_events(ball):
    driven = ball("-0.8*v + 1").having(simulation={"time": 5})
    tree = driven.simulate(h=1.0, v=0.0, cycle=1)
    # 5 = 0.8*5 + 1.
    assert tree["cycles"].x.sel(state="v").item() == pytest.approx(5.0, abs=1e-9)
    assert tree["cycles"].period.item() == pytest.approx(10 / 9.81, abs=1e-9)
    assert tree["simulation_events"].sizes["jump"] > 3


def test_files_go_when_nothing_is_left(double_integrator):
    def folder(ds):
        return Path(ds.encoding["source"]).parent

    ds = double_integrator.solve(x=[0.1, 0.2])
    ours = folder(ds)
    copied = ds.copy(deep=True)
    assert ours.parent.parent == Path(tempfile.gettempdir()) and ours.exists()
    del ds
    gc.collect()
    assert ours.exists(), "a copy still needs it"
    del copied
    gc.collect()
    assert not ours.exists()


def test_nothing_is_left_of_what_was_refused(double_integrator, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(pycostate.InputError):
        double_integrator.study()
    with pytest.raises(pycostate.InputError):
        double_integrator.solve(x=0.1, backend="tpu")
    assert list(tmp_path.iterdir()) == []


def test_two_threads_solve_at_once(double_integrator):
    x = np.linspace(-0.8, 0.8, 40)
    found = {}
    ticks = 0

    def solve(k):
        found[k] = double_integrator.solve(x=x, v=0.1).V.values

    threads = [threading.Thread(target=solve, args=(k,)) for k in range(2)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        ticks += 1
        time.sleep(0.001)
    assert ticks > 1, "the lock of the interpreter is free meanwhile"
    np.testing.assert_array_equal(found[0], found[1])


@pytest.mark.filterwarnings("ignore::pycostate.CostateWarning")
def test_progress_is_told(double_integrator):
    steps = []
    double_integrator.solve(x=np.linspace(-0.8, 0.8, 400), v=[0.1, 0.2], progress=steps.append)
    assert all(step is None or isinstance(step, str) for step in steps)

    def refuse(step):
        raise RuntimeError("enough")

    p = double_integrator.having(map={"error": 1e-7})
    with pytest.raises(RuntimeError, match="enough"):
        p.map(progress=refuse)


def test_a_time_limit_keeps_what_is_done(scenarios):
    p = pycostate.Problem.load(scenarios / "moore_greitzer.toml").using(backend="cpu")
    bounds = np.array(list(p.region.values()))
    x = np.random.default_rng(3).uniform(*bounds.T, (20_000, 4))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        ds = p.solve(x, time_limit=0.5)
    assert any("time limit" in str(w.message) for w in told)
    words = dict(zip(ds.status.attrs["flag_values"], ds.status.attrs["flag_meanings"].split()))
    statuses = {words[code] for code in np.unique(ds.status)}
    assert "out_of_time" in statuses


def test_ctrl_c_keeps_what_is_done(scenarios):
    program = f"""
import os, signal, threading, time
import numpy as np, pycostate
# A shell in the background has told its children to ignore it.
signal.signal(signal.SIGINT, signal.default_int_handler)
p = pycostate.Problem.load({str(scenarios / "moore_greitzer.toml")!r}).using(backend="cpu")
bounds = np.array(list(p.region.values()))
x = np.random.default_rng(3).uniform(*bounds.T, (20_000, 4))
sent = []
def send():
    sent.append(time.monotonic())
    os.kill(os.getpid(), signal.SIGINT)
threading.Timer(1.0, send).start()
try:
    p.solve(x)
    print("not interrupted")
except pycostate.Interrupted as stopped:
    print(stopped.result.sizes["point"], int(stopped.result.V.notnull().sum()), time.monotonic() - sent[0])
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=True
    )
    points, solved, seconds = done.stdout.split()
    assert points == "20000" and int(solved) < 20_000
    assert float(seconds) < 5.0, "a second on a machine with nothing else to do"


def test_import_is_fast_enough_to_be_unnoticed():
    # No timing: xarray, h5py and matplotlib are not imported before they are needed.
    program = "import sys, pycostate; print(sorted({'xarray', 'h5py', 'matplotlib', 'pandas'} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


@pytest.fixture(scope="module")
def command():
    """The command that the wheel brings."""
    path = Path(sys.executable).with_name("costate")
    assert path.exists()
    return path


def test_the_command(command, scenarios, tmp_path):
    def costate(*arguments):
        return subprocess.run(
            [command, *map(str, arguments)], cwd=tmp_path, capture_output=True, text=True
        )

    assert "costate 0" in costate("--version").stdout
    assert costate("check", scenarios / "pendulum.toml").returncode == 0
    wrong = costate("check", "nothing.toml")
    assert wrong.returncode == 2 and "nothing.toml" in wrong.stderr


# Scenes that take seconds; what each is asked for.
SCENES = [
    ("pendulum", "shoot-out", "sweep"),
    ("linear_quadratic", "shoot-out", "sweep"),
    ("manufactured", "homotopy", "homotopy"),
    ("finite_horizon", "shoot-out", "sweep"),
    ("compass_gait", "simulate", "simulate"),
]


@pytest.mark.parametrize(("scene", "part", "method"), SCENES)
def test_the_same_bits_as_the_command(command, scenarios, tmp_path, scene, part, method):
    path = scenarios / f"{scene}.toml"
    out = tmp_path / "command.h5"
    subprocess.run(
        [command, part, path, "--backend", "cpu", "--out", out], check=True, capture_output=True
    )
    want = pycostate.open(out)
    made = getattr(pycostate.Problem.load(path), method)(backend="cpu", out=tmp_path / "python.h5")
    groups = want.children if isinstance(made, xr.DataTree) else {"trajectories": None}
    assert groups
    for name in groups:
        ours = made[name].to_dataset() if isinstance(made, xr.DataTree) else made
        theirs = want[name].to_dataset()
        assert set(ours.variables) == set(theirs.variables)
        for variable in theirs.variables:
            np.testing.assert_array_equal(ours[variable].values, theirs[variable].values)


def test_a_report(double_integrator, tmp_path):
    ds = double_integrator.having(
        shoot_out={"value_max": 0.5, "spacing": 0.2, "samples": 10}
    ).sweep(out=tmp_path / "di.h5")
    report = pycostate.report(ds)
    assert report.page.exists() and "<svg" in report.html
    assert "iframe" in report._repr_html_()
    assert "phase" in report.pictures or report.pictures


def test_results_are_pickled(double_integrator, tmp_path):
    import pickle

    ds = double_integrator.solve(x=[0.1, 0.2], out=tmp_path / "a.h5")
    again = pickle.loads(pickle.dumps(ds))
    xr.testing.assert_identical(again, ds)
