"""Problems: how they are made, and what is wrong with them."""

import copy
import pickle

import numpy as np
import pycostate
import pytest

SQRT2 = np.sqrt(2.0)
P = np.array([[SQRT2, 1.0], [1.0, SQRT2]])


def test_check_has_the_local_solution(double_integrator):
    check = double_integrator.check()
    np.testing.assert_allclose(check.P, P, atol=1e-10)
    np.testing.assert_allclose(check.K, P[1:], atol=1e-10)
    assert np.all(check.eigenvalues.real < 0)
    assert check.optimal_control == {"u": "-p_v"}
    assert "Riccati" in check.text and "Riccati" in repr(check)
    assert "<pre>" in check._repr_html_()


def test_a_scene_and_its_parameters(scenarios):
    p = pycostate.Problem.load(scenarios / "pendulum.toml")
    q = p.set(q=7.5)
    assert p.parameters["q"] == 5.55 and q.parameters["q"] == 7.5
    assert q.set(g=9.8).parameters["q"] == 7.5
    assert pycostate.Problem.load(scenarios / "pendulum.toml", q=7.5).parameters == q.parameters
    assert p.states == ("theta", "omega") and p.controls == ("u",)
    assert p.reference["theta"] == -1.5
    # An expression of earlier parameters.
    assert p.set(r="g/2").parameters["r"] == pytest.approx(4.905)


def test_sections_are_merged(double_integrator):
    p = double_integrator.having(map={"error": 1e-3}, region={"x": [-2, 2]})
    assert p.region == {"x": (-2.0, 2.0), "v": (-1.0, 1.0)}
    assert 'error = 0.001' in p.text
    assert "map" not in p.having(map=None).text


def test_a_problem_is_saved_and_read(double_integrator, tmp_path):
    path = tmp_path / "di.toml"
    double_integrator.save(path)
    again = pycostate.Problem.load(path)
    assert again.text == double_integrator.text
    assert again.title == "Double integrator"


def test_mistakes_have_their_place():
    with pytest.raises(pycostate.SceneError) as caught:
        pycostate.Problem(
            states=["x"],
            controls=["u"],
            dynamics={"x": "sn(x) + u"},
            running="x^2 + u^2",
            equilibrium={"x": 0, "u": 0},
            region={"x": [-1, 1]},
        )
    error = caught.value
    assert "unknown function `sn`" in str(error)
    assert error.file == "problem.toml" and error.line == 8 and error.column == 6
    assert error.problems[0]["help"] == "did you mean `sin`?"
    assert isinstance(error, ValueError)
    # It goes to other processes.
    assert pickle.loads(pickle.dumps(error)).line == 8


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda p: p.set(q=1), "no parameter `q`"),
        (lambda p: p.solve([[1.0, 2.0, 3.0]]), "(N, 2)"),
        (lambda p: p.solve([[np.nan, 0.0]]), "no finite number"),
        (lambda p: p.solve([["a", "b"]]), "is no number"),
        (lambda p: p.solve(np.ones((2, 2), complex)), "complex128 is no number"),
        (lambda p: p.solve([[0.1, 0.2]], x=0.3), "not both"),
        (lambda p: p.solve(x=0.1, precision="f16"), "f16"),
        (lambda p: p.solve(x=0.1, method="euler"), "euler"),
        (lambda p: p.solve(x=0.1, backend="tpu"), "tpu"),
        (lambda p: p.solve(x=0.1, rtol=-1.0), "rtol"),
        (lambda p: p.study(), "no [study]"),
        (lambda p: p.attenuation(), "no [attenuation]"),
        (lambda p: p.value("nothing.h5"), "nothing.h5"),
        (lambda p: p.value(p.solve(x=[0.1, 0.2]).V), "as pycostate has made it"),
        (lambda p: p.evaluate(), "closed_loop"),
    ],
)
def test_what_is_given_wrong_is_said(double_integrator, call, words):
    with pytest.raises(pycostate.InputError) as caught:
        call(double_integrator)
    assert words in str(caught.value)


def test_unknown_options_are_refused(double_integrator):
    with pytest.raises(TypeError, match="tolerance"):
        double_integrator.solve(x=0.1, tolerance=1e-3)
    with pytest.raises(FileNotFoundError):
        pycostate.open("nothing.h5")


def test_problems_print(double_integrator):
    assert "states x, v" in repr(double_integrator)
    assert "Double integrator" in double_integrator._repr_html_()
    assert copy.copy(double_integrator).text == double_integrator.text
