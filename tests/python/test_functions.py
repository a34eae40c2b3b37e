"""Laws that are functions of Python."""

import numpy as np
import pycostate
import pytest

SQRT2 = np.sqrt(2.0)


def lqr(x):
    return -x[:, :1] - SQRT2 * x[:, 1:]


def test_the_optimal_law_costs_v(double_integrator):
    x0 = [[0.5, 0.2], [-0.3, 0.4]]
    tree = double_integrator.simulate(lqr, x0, time=25.0, rtol=1e-10)
    flown = tree["simulation"]
    want = double_integrator.solve(x0).V
    np.testing.assert_allclose(flown.J, want, rtol=1e-8)
    assert abs(flown.x_end).max() < 1e-6
    assert flown.attrs["law"] == "lqr" and (flown.status == 0).all()
    # As the engine flies it.
    engine = double_integrator.simulate("lqr", x0, time=25.0, rtol=1e-10)
    np.testing.assert_allclose(flown.x_end, engine["simulation"].x_end, atol=1e-8)
    samples = tree["simulation_samples"]
    np.testing.assert_allclose(samples.u[:, 0], lqr(samples.x.values)[:, 0], atol=1e-12)
    assert samples.sizes["sample"] == 2 * 51


def test_the_law_of_a_map(double_integrator):
    v = double_integrator.value(double_integrator.map(error=1e-4))
    tree = double_integrator.simulate(v.u, x=[0.4, -0.2], v=0.1, time=8.0, rtol=1e-6)
    cost = tree["simulation"].J.values
    left = v(tree["simulation"].x_end.values)
    assert cost + left == pytest.approx(v([[0.4, 0.1], [-0.2, 0.1]]), rel=1e-3)


def test_bounds_and_guards():
    p = pycostate.Problem(
        states=["x", "v"],
        controls={"u": {"min": -1, "max": 1}},
        dynamics={"x": "v", "v": "u"},
        running="x^2 + u^2",
        equilibrium={"x": 0, "v": 0, "u": 0},
        region={"x": [-4, 4], "v": [-4, 4]},
        guards={"near": "x < 2"},
    )
    tree = p.simulate(lambda x: np.full(len(x), 7.0), [[0.0, 0.0], [0.0, -9.0]], time=3.0)
    flown = tree["simulation"]
    # u is 1: x = t^2/2 is 2 after 2.
    words = dict(zip(flown.status.attrs["flag_values"].tolist(), flown.status.attrs["flag_meanings"].split()))
    assert [words[int(s)] for s in flown.status] == ["guard_near", "time"]
    assert flown.t_end[0].item() == pytest.approx(2.0, abs=1e-6)
    assert flown.x_end[1].values == pytest.approx([-27 + 4.5, -6.0])


@pytest.mark.parametrize(
    ("law", "words"),
    [
        (lambda x: x, "needed is (2, 1)"),
        (lambda x: np.array(["a", "b"]), "no number"),
        (lambda x: x[:, :1] * 1j, "no number"),
    ],
)
def test_what_a_law_gives_wrong_is_said(double_integrator, law, words):
    with pytest.raises(pycostate.InputError) as caught:
        double_integrator.simulate(law, [[0.1, 0.2], [0.3, 0.4]], time=1.0)
    assert words in str(caught.value)


def test_errors_of_a_law_are_its_own(double_integrator):
    def broken(x):
        raise ZeroDivisionError("in the law")

    with pytest.raises(ZeroDivisionError, match="in the law"):
        double_integrator.simulate(broken, [[0.1, 0.2]], time=1.0)


def test_a_law_without_values_ends_the_flight(double_integrator):
    tree = double_integrator.simulate(
        lambda x: np.where(x[:, :1] > 0.0, 0.0, np.nan), [[0.5, -1.0], [0.5, 1.0]], time=1.0
    )
    flown = tree["simulation"]
    assert flown.status.values.tolist() == [11, 0]
    assert flown.t_end[0].item() == pytest.approx(0.5, abs=1e-3)
    with pytest.raises(pycostate.InputError, match="how long"):
        double_integrator.simulate(lqr, [[0.1, 0.2]])
