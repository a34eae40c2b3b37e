"""Laws as FMUs, checked and run by FMPy (https://github.com/CATIA-Systems/FMPy)."""

import subprocess
import zipfile

import fmpy
import numpy as np
import pycostate
import pytest
from fmpy.model_description import read_build_description
from fmpy.validation import validate_fmu


@pytest.fixture(scope="module")
def law():
    p = pycostate.Problem(
        title='Two <masses> & a "spring"',
        states={"x": {"unit": "m", "long_name": "place"}, "v": {"unit": "m/s"}},
        controls={"u": {"unit": "N", "min": -0.5, "max": 0.5}},
        dynamics={"x": "v", "v": "u"},
        running="0.5*(x^2 + u^2)",
        equilibrium={"x": 0, "v": 0, "u": 0},
        region={"x": [-1, 1], "v": [-1, 1]},
        shoot_out={"value_max": 1.0, "spacing": 0.2, "samples": 20},
        feedback={"small": {"fit": "u", "hidden": [3], "iterations": 30, "starts": 2}},
    ).using(backend="cpu")
    return p.fit(p.sweep())


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
def test_an_fmu_gives_the_law(law, tmp_path, kind):
    path = tmp_path / "law.fmu"
    law.to_fmu(path, compiled=True)
    assert validate_fmu(str(path)) == []
    t = np.linspace(0.0, 1.0, 21)
    x = np.stack([np.sin(6 * t), np.cos(5 * t) - 0.5], axis=-1)
    signals = np.array(
        list(zip(t, *x.T)), dtype=[("time", float), ("x", float), ("v", float)]
    )
    got = fmpy.simulate_fmu(
        str(path),
        fmi_type=kind,
        input=signals,
        start_time=0.0,
        stop_time=1.0,
        output_interval=0.05,
        output=["u", "x"],
    )
    # What the FMU was given when it was asked, whatever the importer does between samples.
    at = np.stack([got["x"], np.interp(got["time"], t, x[:, 1])], axis=-1)
    samples = [k for k, time in enumerate(got["time"]) if np.isclose(t, time, atol=1e-9).any()]
    assert len(samples) > 15
    held = {round(float(b), 12): a for a, b in zip(law(x)[:, 0], x[:, 0])}
    for k in samples:
        want = held.get(round(float(got["x"][k]), 12), law(at[k])[0])
        assert got["u"][k] == pytest.approx(want, abs=1e-12)
    assert abs(got["u"]).max() <= 0.5


def test_an_fmu_is_source(law, tmp_path):
    path = tmp_path / "law.fmu"
    law.save(path)
    with zipfile.ZipFile(path) as fmu:
        names = fmu.namelist()
        assert "sources/fmi3.c" in names and not any(n.startswith("binaries") for n in names)
        assert b"small" in fmu.read("sources/law.h")
        fmu.extractall(tmp_path / "law")
    (build,) = read_build_description(str(path))
    assert build.modelIdentifier == "small"
    assert build.sourceFileSets[0].sourceFiles == ["fmi3.c"]
    subprocess.run(
        ["cc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-c", "fmi3.c", "-o", "fmi3.o"],
        cwd=tmp_path / "law/sources",
        check=True,
    )
    description = fmpy.read_model_description(str(path))
    inputs = {v.name: v.unit for v in description.modelVariables if v.causality == "input"}
    assert inputs == {"x": "m", "v": "m/s"}
    assert [v.name for v in description.modelVariables if v.causality == "output"] == ["u"]
    # The same token, however often: a tool knows it again.
    law.save(tmp_path / "again.fmu")
    assert fmpy.read_model_description(str(tmp_path / "again.fmu")).guid == description.guid


def test_what_is_no_fmu_is_said(law, tmp_path):
    with pytest.raises(pycostate.InputError, match="name a file .fmu"):
        law.to_fmu(tmp_path / "law.zip")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("outputs", [["w"], ["w", "u"]])
def test_outputs_have_their_own_names(tmp_path, outputs):
    p = pycostate.Problem(
        states=["x", "v"],
        controls={"u": {}, "w": {"unit": "V"}},
        dynamics={"x": "v + 0.5*w", "v": "u"},
        running="0.5*(x^2 + u^2 + 3*w^2)",
        equilibrium={"x": 0, "v": 0, "u": 0, "w": 0},
        region={"x": [-1, 1], "v": [-1, 1]},
        shoot_out={"value_max": 1.0, "spacing": 0.2, "samples": 20},
        feedback={"law": {"fit": "u", "output": outputs, "hidden": [3], "iterations": 30, "starts": 1}},
    ).using(backend="cpu")
    law = p.fit(p.sweep())
    law.to_fmu(tmp_path / "law.fmu", compiled=True)
    assert validate_fmu(str(tmp_path / "law.fmu")) == []
    x = [0.4, -0.3]
    got = fmpy.simulate_fmu(
        str(tmp_path / "law.fmu"), start_values=dict(zip("xv", x)), stop_time=0.1, output=law.outputs
    )
    given = law(x)
    names = p.controls if len(outputs) == 2 else law.outputs
    assert law.outputs == tuple(outputs)
    assert {n: got[n][-1] for n in outputs} == pytest.approx(dict(zip(names, given)), abs=1e-12)
    # As the engine flies it.
    if len(outputs) == 2:
        both = [p.simulate(f, x, time=1.0, rtol=1e-9)["simulation"].x_end.values for f in (law, lambda x: law(x))]
        assert both[0] == pytest.approx(both[1], abs=1e-7)
