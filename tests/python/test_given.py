"""What users give, in the forms in which they have it, and what they get wrong."""

import copy
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from fractions import Fraction
from pathlib import Path

import numpy as np
import pandas as pd
import pycostate
import pytest
import xarray as xr

X = [0.1, 0.9]


@pytest.fixture(scope="module")
def value(double_integrator):
    return double_integrator.value(double_integrator.map(error=1e-3))


@pytest.fixture(scope="module")
def law(double_integrator):
    p = double_integrator.having(
        feedback={"law": {"fit": "u", "hidden": [4], "iterations": 20, "starts": 1}}
    )
    return p.fit(p.solve(x=np.linspace(-0.5, 0.5, 9), v=np.linspace(-0.5, 0.5, 9)))


@pytest.mark.parametrize(
    "given",
    [
        pd.DataFrame({"v": [X[1]], "x": [X[0]]}),
        xr.Dataset({"v": ("k", [X[1]]), "x": ("k", [X[0]])}),
        xr.DataArray([X[::-1]], dims=("k", "state"), coords={"state": ["v", "x"]}),
        xr.DataArray([X], dims=("k", "state")),
        {"v": [X[1]], "x": X[0]},
        np.asfortranarray([X]),
        np.array([X], dtype=">f8"),
        [[Fraction(1, 10), Fraction(9, 10)]],
        pd.Series(X),
    ],
    ids=lambda given: type(given).__name__,
)
def test_names_count_everywhere(double_integrator, value, law, given):
    right = double_integrator.solve([X])
    assert double_integrator.solve(given).V.values.ravel() == right.V.values
    assert np.ravel(value(given)) == pytest.approx(right.V.values, rel=1e-3)
    assert np.ravel(value.u(given)) == pytest.approx(right.u.values.ravel(), rel=1e-3)
    assert np.ravel(law(given)) == pytest.approx(np.ravel(law(X)), abs=1e-15)


def test_states_of_a_result(double_integrator):
    points = double_integrator.solve([[0.5, 0.5], [1.0, 0.0]])
    again = double_integrator.solve(points)
    assert again.V.values.tolist() == points.V.values.tolist()
    plane = double_integrator.solve(x=(0.1, 0.2, 0.3), v=0.5)
    assert double_integrator.solve(plane).V.dims == ("x",)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda p: p.solve(xr.Dataset({"X": ("k", [1.0])})), "names no state"),
        (lambda p: p.solve(pd.DataFrame({"X": [1.0]})), "no column of a state"),
        (lambda p: p.solve(xr.Dataset({"x": ("k", [1j])})), "no number"),
        (lambda p: p.solve(np.ma.masked_values([[0.1, 7.0]], 7.0)), "no finite number"),
        (lambda p: p.solve(np.empty((0, 2))), "no states"),
        (lambda p: p.solve(x=[]), "no states"),
        (lambda p: p.solve([[1.0, 2.0], [3.0]]), "points"),
        (lambda p: p.solve(x=0.1, out="x.csv"), ".h5"),
        (lambda p: p.solve(x=0.1, seed=1.5), "seed = 1.5: a whole number"),
        (lambda p: p.solve(x=0.1, rtol="1e-8"), "rtol"),
        (lambda p: p.solve(x=0.1, time_limit=-1), "time_limit"),
        (lambda p: p.solve(x=0.1, one_sheet="yes"), "True or False"),
        (lambda p: p.solve(x=0.1, trajectories=True, samples=10**15), "samples"),
        (lambda p: p.map(error=1e-2, counts={"X": 3}), "counts: X"),
        (lambda p: p.map(error=1e-2, counts=[3]), "1 numbers for 2 states"),
        (lambda p: p.map(error="1e-3"), "a number is needed"),
        (lambda p: p.having(map=None).map(), "p.map(error="),
        (lambda p: p.simulate([[0.1, 0.2]], time=1.0), "the law comes first"),
        (lambda p: p.simulate("lqr", X, time=-1.0), "time"),
        (lambda p: p.simulate("lqr", X, time=float("nan")), "time"),
        (lambda p: p.simulate("lqr", X), "how long"),
        (lambda p: p.simulate("lqr", np.empty((0, 2)), time=1.0), "no states"),
        (lambda p: p.simulate(lambda x: 0 * x[:, :1], X, time=1.0, backend="gpu"), "flown in Python"),
        (lambda p: p.fit(p.solve(x=0.1)), "no [feedback]"),
        (lambda p: p.set(a=[1]), "parameter a"),
        (lambda p: p.evaluate(added=[lambda x: x]), "p.simulate(function"),
        (lambda p: pycostate.Problem(running="1", cost={"running": "2"}), "twice"),
        (lambda p: pycostate.Problem(states=5), "states = 5"),
        (lambda p: pycostate.Problem(cost=3), "cost = 3"),
        (lambda p: pycostate.load_law("law.onnx", p), ".toml"),
    ],
)
def test_mistakes_are_named(double_integrator, call, words):
    with pytest.raises(pycostate.InputError) as caught:
        call(double_integrator)
    assert words in str(caught.value)
    assert "--" not in str(caught.value)


def test_a_misspelt_state_is_guessed(double_integrator):
    p = pycostate.Problem.parse(double_integrator.text.replace("x", "theta"))
    with pytest.raises(TypeError, match="did you mean theta"):
        p.solve(thta=1.0)


def named(name):
    return pycostate.Problem(
        states=[name, "y"],
        controls=["w"],
        dynamics={name: "y", "y": "w"},
        running=f"{name}^2 + y^2 + w^2",
        equilibrium={name: 0, "y": 0, "w": 0},
        region={name: [-1, 1], "y": [-1, 1]},
    )


@pytest.mark.parametrize("name", ["V", "u", "p", "status", "state", "control", "t", "samples", "sel"])
def test_states_of_any_name(name):
    p, plain = named(name), named("x")
    x = [-0.5, 0.0, 0.7]
    right = plain.solve(x=x, y=0.5)
    if name == "samples":
        with pytest.raises(pycostate.InputError, match="give the states as points"):
            p.solve(**{name: x}, y=0.5)
        found = p.solve([[a, 0.5] for a in x])
    else:
        found = p.solve(**{name: x}, y=0.5)
        label = f"state_{name}" if name in right.variables or name in right.dims else name
        assert found[label].values.tolist() == x
    assert found.V.values == pytest.approx(right.V.values, rel=1e-12)
    assert found.u.values == pytest.approx(right.u.values, rel=1e-9)
    v = p.value(found)
    if name in ("V", "u", "p", "status", "state", "control"):
        with pytest.raises(pycostate.InputError, match="no axis of a grid"):
            p.map(error=1e-2)
    else:
        assert v.grid(**{name: [0.1, 0.2]}, counts=3).V.shape == (2, 3)
    if name == "t":
        assert v(t=0.7, y=0.5) == pytest.approx(v([0.7, 0.5]), rel=1e-12)


def test_results_of_other_problems(double_integrator):
    ds = double_integrator.solve([X])
    with pytest.raises(pycostate.InputError, match="its states are x, v, not x, y"):
        named("x").value(ds)
    other = double_integrator.having(cost={"running": "5*(x^2 + v^2 + u^2)"})
    with pytest.warns(pycostate.CostateWarning, match="another problem") as said:
        other.value(ds)
    assert said[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        double_integrator.value(ds)
        double_integrator.having(map={"error": 0.1}).value(ds)


def test_a_file_that_was_overwritten(double_integrator, tmp_path):
    path = tmp_path / "map.h5"
    first = double_integrator.solve([X], out=path)
    double_integrator.solve([X, X], out=path)
    with pytest.raises(pycostate.InputError, match="another file by now"):
        double_integrator.value(first)
    kept = tmp_path / "kept.h5"
    again = double_integrator.solve([X])
    again.costate.save(kept)
    assert pycostate.open(kept)["points"].V.values == again.V.values


def test_paths_are_where_they_were(double_integrator, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ds = double_integrator.solve([X], out="here.h5")
    monkeypatch.chdir("/")
    assert np.isfinite(double_integrator.value(ds)([0.1, 0.9]))


def test_what_was_set_is_saved(tmp_path):
    p = pycostate.Problem(
        states=["x"],
        controls={"u": (-1, 1), "w": None},
        parameters={"a": 1.0, "b": "2*a"},
        dynamics={"x": "a*x + b*u + w"},
        running="x^2 + u^2 + w^2",
        equilibrium={"x": 0, "u": 0, "w": 0},
        region={"x": [-1, 1]},
    ).set(a=4, b="a - 1")
    p.save(tmp_path / "new" / "scene.toml")
    assert pycostate.Problem.load(tmp_path / "new" / "scene.toml").parameters == {"a": 4.0, "b": 3.0}
    assert p.having(parameters={"a": 9}).parameters == {"a": 9.0, "b": 8.0}
    twin = pickle.loads(pickle.dumps(p))
    assert twin.parameters == p.parameters and twin.text == p.text
    assert copy.deepcopy(p) is p


def test_laws_and_values_travel(double_integrator, value, law):
    assert pickle.loads(pickle.dumps(law))(X) == law(X)
    assert pickle.loads(pickle.dumps(value))(X) == value(X)


def _asked(value):
    return float(value(X))


def test_processes(value):
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.map(_asked, [value]) == [value(X)]
    if sys.platform == "linux":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with multiprocessing.get_context("fork").Pool(1) as pool:
                with pytest.raises(pycostate.CostateError, match="spawn"):
                    pool.map(_asked, [value])


def test_a_law_that_knows_the_time():
    p = pycostate.Problem(
        states=["x"],
        controls=["u"],
        dynamics={"x": "u"},
        running="u^2",
        terminal="10*x^2",
        final_time=2,
        region={"x": [-1, 1]},
        map={"error": 1e-4},
    )
    v = p.value(p.homotopy())
    # V = x^2 / (1/10 + 2 - t), u = -x / (1/10 + 2 - t).
    times = np.array([0.0, 0.7, 1.9])
    assert v([0.5], t=times) == pytest.approx(0.25 / (2.1 - times), rel=1e-3)
    flown = p.simulate(v.u, [[0.5], [-0.3]], samples=4)
    assert flown["simulation"].J.values == pytest.approx(np.array([0.25, 0.09]) / 2.1, rel=1e-4)
    mine = p.simulate(lambda x, t: -x / (2.1 - t)[:, None], [[0.5]])
    assert mine["simulation"].J.item() == pytest.approx(0.25 / 2.1, rel=1e-8)


def test_a_value_is_flown_as_its_law(double_integrator, value):
    both = [double_integrator.simulate(law, X, time=2.0) for law in (value, value.u)]
    assert both[0]["simulation"].J.item() == both[1]["simulation"].J.item()


def test_costs_are_as_exact_as_states(double_integrator):
    p = double_integrator.having(guards={"near": "x < 0.4"}, cost={"running": "sin(20*x)^2 + x^2 + v^2 + u^2"})

    def push(x):
        return np.ones((len(x), 1))

    # x = t^2/2: J until x = 0.4 by quadrature.
    t = np.linspace(0.0, np.sqrt(0.8), 200_001)
    running = np.sin(10 * t**2) ** 2 + t**4 / 4 + t**2 + 1
    right = float(np.sum(0.5 * (running[1:] + running[:-1]) * np.diff(t)))
    for rtol, bound in ((1e-5, 1e-4), (1e-10, 1e-8)):
        flown = p.simulate(push, [0.0, 0.0], time=5.0, samples=0, rtol=rtol)["simulation"]
        assert flown.J.item() == pytest.approx(right, rel=bound)


def test_time_limits_of_python_laws(double_integrator):
    begun = time.monotonic()
    with pytest.raises(pycostate.OutOfTime):
        # It chatters.
        double_integrator.simulate(lambda x: -np.sign(x[:, :1] + x[:, 1:]), X, time=30.0, time_limit=0.5)
    assert time.monotonic() - begun < 5


def test_flights_of_functions_are_results(double_integrator, tmp_path):
    tree = double_integrator.simulate(lambda x: -x[:, :1] - x[:, 1:], X, time=1.0, out=tmp_path / "f.h5")
    stored = pycostate.open(tmp_path / "f.h5")
    for group in ("simulation", "simulation_samples", "simulation_events"):
        assert stored[group].to_dataset().identical(tree[group].to_dataset())
    assert stored["simulation"].attrs["method"] == "dopri5"
    engine = double_integrator.simulate("lqr", X, time=1.0)
    for name, variable in engine["simulation"].variables.items():
        assert tree["simulation"][name].attrs.get("units") == variable.attrs.get("units")
    assert "simulation" in pycostate.report(tree, tmp_path / "page.html").pictures[0]


def test_an_early_end_of_a_map(double_integrator):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(pycostate.OutOfTime):
            double_integrator.map(error=1e-8, time_limit=0.001)


def test_nothing_kept_is_no_error(double_integrator):
    swept = double_integrator.having(shoot_out={"value_max": 0.1}).sweep(keep="nothing")
    assert not swept.variables and "scenario" in swept.attrs


def test_a_scene_is_left_alone(double_integrator, tmp_path):
    scene = tmp_path / "mine.toml"
    scene.write_text("# mine\n" + double_integrator.text)
    p = pycostate.Problem.load(scene).having(title="another", shoot_out={"value_max": 0.1})
    p.bench(out=tmp_path / "b.h5", trajectories=64, passes=1, backend="cpu", rtol=1e-4, method="rk4")
    assert scene.read_text().startswith("# mine")
    assert "problem.toml" not in os.listdir(tmp_path)


def test_what_killed_ones_leave_is_removed(tmp_path, double_integrator):
    code = f"""
import pycostate, sys, time
p = pycostate.Problem.parse({double_integrator.text!r})
ds = p.solve(x=0.1)
print("ready", flush=True)
time.sleep(60)
"""
    there = {**os.environ, "TMPDIR": str(tmp_path)}
    process = subprocess.Popen([sys.executable, "-c", code], env=there, stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"ready\n"
    process.send_signal(signal.SIGKILL)
    process.wait()
    [left] = tmp_path.glob("pycostate-*")
    # A while later.
    os.utime(left / "in_use", (0, 0))
    again = code.replace("time.sleep(60)", "")
    subprocess.run([sys.executable, "-c", again], env=there, check=True, stdout=subprocess.DEVNULL)
    assert not list(tmp_path.glob("pycostate-*"))
    assert tempfile.gettempdir() != str(tmp_path)


def test_the_accessor_is_there_with_xarray():
    code = "import xarray, pycostate; xarray.Dataset().costate; assert hasattr(xarray.DataTree, 'costate')"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_environment_is_left_alone():
    code = "import os, pycostate; assert 'XDG_RUNTIME_DIR' not in os.environ"
    bare = {k: v for k, v in os.environ.items() if k != "XDG_RUNTIME_DIR"}
    subprocess.run([sys.executable, "-c", code], check=True, env=bare)
    assert Path(pycostate.__file__).exists()


def test_tables_and_their_rows(double_integrator, value):
    table = pd.DataFrame({"v": [0.2, 0.3], "x": [0.1, 0.4], "note": ["a", "b"]})
    right = double_integrator.solve([[0.1, 0.2], [0.4, 0.3]]).V.values
    assert double_integrator.solve(table).V.values.tolist() == right.tolist()
    assert double_integrator.solve(table.set_index("x")).V.values.tolist() == right.tolist()
    assert double_integrator.solve(table.set_index("x", drop=False)).V.values.tolist() == right.tolist()
    assert value(table.iloc[0]) == pytest.approx(right[0], rel=1e-3)
    grid = double_integrator.solve(x=[0.1, 0.4], v=[0.2, 0.3])
    again = double_integrator.solve(grid.to_dataframe().reset_index().drop_duplicates(["x", "v"]))
    assert set(again.V.values) == set(grid.V.values.ravel())
    with pytest.raises(pycostate.InputError, match="v has no column"):
        double_integrator.solve(pd.DataFrame({"x": [0.1], "V": [0.2]}))


def test_a_result_with_laws_is_the_same(double_integrator, tmp_path):
    p = double_integrator.having(feedback={"fit": "u", "hidden": [3], "iterations": 5, "starts": 1})
    path = tmp_path / "fit.h5"
    ds = p.solve(x=np.linspace(-0.5, 0.5, 9), v=np.linspace(-0.5, 0.5, 9), out=path)
    tree = pycostate.open(path)
    p.fit(str(path), names="network")
    p.fit(ds)
    assert p.value(ds)([0.1, 0.3]) == p.value(tree)([0.1, 0.3])
    sent = pickle.dumps(p.value(ds))
    p.solve(x=0.3, out=path)
    with pytest.raises(pycostate.InputError, match="another file"):
        pickle.loads(sent)


@pytest.mark.skipif(sys.platform != "linux", reason="fork")
def test_forked_ones_remove_nothing(double_integrator):
    code = f"""
import os, sys, pycostate
p = pycostate.Problem.parse({double_integrator.text!r})
ds = p.solve(x=0.1)
if os.fork() == 0:
    del ds
    sys.exit(0)
os.wait()
print(len(ds.costate.file.children))
"""
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "2", done.stderr
