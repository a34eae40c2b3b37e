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


BALL = """
states = { h = { unit = "m" }, v = { unit = "m/s" }, n = {} }
controls = { u = { min = -20, max = 20 } }
dynamics = { h = "v", v = "-9.81 + u", n = "0" }
cost = { running = "u^2", terminal = "0", final_time = 1 }
region = { h = [0, 2], v = [-5, 5], n = [0, 10] }
events.floor = { when = "h <= 0", set = { v = "-0.5*v", n = "n + 1" } }
simulation = { initial = { h = 1, v = 0, n = 0 }, time = 2 }
"""


def held(x):
    return np.zeros((len(x), 1))


def words(flown):
    codes = flown.status.attrs
    names = dict(zip(codes["flag_values"].tolist(), codes["flag_meanings"].split()))
    return [names[int(s)] for s in flown.status]


def test_events_are_those_of_the_engine():
    ball = pycostate.Problem.parse(BALL)
    x0 = [[1.0, 0.0, 0.0], [0.5, 3.0, 0.0], [0.0, 2.0, 4.0]]
    tree = ball.simulate(held, x0, events=3, rtol=1e-10)
    engine = ball.simulate(None, x0, events=3, rtol=1e-10)
    assert words(tree["simulation"]) == ["events"] * 3 == words(engine["simulation"])
    mine, its = (t["simulation_events"].to_dataset() for t in (tree, engine))
    for name in ("flight", "event"):
        assert mine[name].values.tolist() == its[name].values.tolist()
    for name in ("t", "before", "after"):
        np.testing.assert_allclose(mine[name], its[name], atol=1e-9)
    # By hand: the fall takes sqrt(2/g), then a bounce of half the speed as long.
    fall = np.sqrt(2 / 9.81)
    np.testing.assert_allclose(mine.t[:3], [fall, 2 * fall, 2.5 * fall], atol=1e-12)
    assert abs(mine.before[:, 0]).max() < 1e-14
    assert tree["simulation"].events.values.tolist() == [3, 3, 3]
    # Points of each phase, first and last included.
    mine, its = (t["simulation_samples"].to_dataset() for t in (tree, engine))
    for name in ("flight", "phase"):
        assert mine[name].values.tolist() == its[name].values.tolist()
    for name in ("t", "x"):
        np.testing.assert_allclose(mine[name], its[name], atol=1e-8)
    second = mine.isel(sample=(mine.flight.values == 0) & (mine.phase.values == 1))
    np.testing.assert_allclose(second.t[[0, -1]], [fall, 2 * fall], atol=1e-12)


def test_bounces_without_end_end():
    ball = pycostate.Problem.parse(BALL)
    flown = ball.simulate(held)["simulation"]
    assert words(flown) == ["zeno"]
    assert flown.t_end.item() == pytest.approx(3 * np.sqrt(2 / 9.81), rel=1e-6)


def test_a_law_that_catches_the_ball():
    ball = pycostate.Problem.parse(BALL)
    # It holds the ball below 0.5 m: after the first bounce u - g = 4 - 10 (h - 0.3) - 4 v is a spring.
    caught = ball.simulate(
        lambda x: np.where(x[:, 2:] > 0, 9.81 - 10 * (x[:, :1] - 0.3) - 4 * x[:, 1:2], 0.0), time=9.0
    )["simulation"]
    assert words(caught) == ["time"]
    np.testing.assert_allclose(caught.x_end[0], [0.3, 0.0, 1.0], atol=1e-6)


@pytest.mark.parametrize(
    ("events", "status", "count"),
    [
        # It ends there; it does not count; it counts on the way back alone.
        ('a = { when = "x >= 0.6", ends = true }', "event_a", 0),
        ('a = { when = "x >= 0.6", where = "v < 0", set = { v = "7" } }', "time", 0),
        ('a = { when = "x <= 0.6", where = "v < 0", set = { c = "c + 1" } }', "time", 2),
        # Of two at a moment both; the second is not met where the first turns the motion.
        ('a = { when = "x >= 0.6", set = { c = "c + 1" } }\nb = { when = "x >= 0.6", set = { c = "c + 10" } }', "time", 4),
        ('a = { when = "x >= 0.6", set = { v = "-v" } }\nb = { when = "x >= 0.6", set = { c = "c + 10" } }', "time", 3),
        # True for a small part of a step.
        ('a = { when = "x >= 0.9999", set = { c = "c + 1" } }', "time", 2),
    ],
)
def test_events_of_an_oscillator(events, status, count):
    scene = f"""
        states = {{ x = {{}}, v = {{}}, c = {{}} }}
        controls = {{ u = {{}} }}
        dynamics = {{ x = "v", v = "-x + u", c = "0" }}
        cost = {{ running = "u^2", terminal = "0", final_time = 1 }}
        region = {{ x = [-1, 1], v = [-1, 1], c = [0, 10] }}
        [events]
        {events}
    """
    p = pycostate.Problem.parse(scene)
    for rtol in (1e-6, 1e-9):
        tree = p.simulate(held, [[0.0, 1.0, 0.0]], time=11.0, rtol=rtol)
        engine = p.simulate(None, [[0.0, 1.0, 0.0]], time=11.0, rtol=1e-9)
        mine, its = (t["simulation_events"].to_dataset() for t in (tree, engine))
        assert words(tree["simulation"]) == [status] == words(engine["simulation"])
        assert mine.sizes["jump"] == count == its.sizes["jump"]
        np.testing.assert_allclose(mine.t, its.t, atol=30 * rtol / (0.014 if "9999" in events else 1))
        np.testing.assert_allclose(tree["simulation"].x_end, engine["simulation"].x_end, atol=100 * rtol)


def test_a_gait_under_a_function(scenarios):
    p = pycostate.Problem.load(scenarios / "compass_gait.toml")
    engine = p.simulate(events=4)
    start = engine["simulation"].x0.values
    tree = p.simulate(lambda x: np.zeros((len(x), len(p.controls))), start, events=4, rtol=1e-10)
    assert words(tree["simulation"]) == ["events"] == words(engine["simulation"])
    np.testing.assert_allclose(tree["simulation_events"].t, engine["simulation_events"].t, atol=1e-8)
    np.testing.assert_allclose(tree["simulation"].x_end, engine["simulation"].x_end, atol=1e-7)


def clock(**events):
    return pycostate.Problem(
        states=["c", "n"],
        controls=["u"],
        dynamics={"c": "1", "n": "0"},
        running="u^2",
        terminal="0",
        final_time=10,
        region={"c": [0, 10], "n": [0, 50]},
        events=events,
    )


def test_a_clock_ticks_at_stored_times():
    p = clock(tick={"when": "c >= 0.1", "set": {"c": "0", "n": "n + 1"}})
    x0 = [[0.0, 0.0], [0.05, 0.0]]
    for samples in (0, 50):
        flown = p.simulate(held, x0, time=5.0, samples=samples)["simulation"]
        assert words(flown) == ["time", "time"]
        assert flown.events.values.tolist() == p.simulate(None, x0, time=5.0)["simulation"].events.values.tolist()


def test_conditions_take_part_in_the_steps():
    p = clock(peak={"when": "cos(20*c) >= 0.95", "set": {"n": "n + 1"}})
    for samples in (0, 50):
        flown = p.simulate(held, [[0.1, 0.0]], samples=samples)["simulation"]
        assert flown.x_end.values[0] == pytest.approx([10.1, 32.0], abs=1e-9)


def test_an_end_on_the_surface_of_a_bounce():
    ball = pycostate.Problem.parse(BALL).having(
        events={"stop": {"when": "h <= 0", "where": "n >= 2", "ends": True}}
    )
    assert words(ball.simulate(held)["simulation"]) == ["event_stop"] == words(ball.simulate()["simulation"])


@pytest.mark.parametrize("when", ["(c-5)^2 >= 0.01", "cos(5*c) <= 0.95", "cos(10*c) >= 0"])
@pytest.mark.parametrize("rtol", [1e-5, 1e-9])
def test_what_is_short_is_met(when, rtol):
    p = clock(a={"when": when, "set": {"n": "n + 1"}})
    mine, its = (p.simulate(law, [[0.0, 0.0]], rtol=rtol) for law in (held, None))
    assert mine["simulation"].events.values.tolist() == its["simulation"].events.values.tolist()
    np.testing.assert_allclose(mine["simulation_events"].t, its["simulation_events"].t, atol=rtol)


@pytest.mark.parametrize("order", [("stop", "add"), ("add", "stop", "reset"), ("stop", "add", "reset")])
@pytest.mark.parametrize("where", ["n >= 1", "sqrt(n - 0.5) >= 0", "n >= 7"])
def test_ends_at_the_moment_of_jumps(order, where):
    there = {
        "stop": {"when": "c >= 0.7", "where": where, "ends": True},
        "add": {"when": "c >= 0.7", "set": {"n": "n + 1"}},
        "reset": {"when": "c >= 0.7", "set": {"c": "0"}},
    }
    p = clock(**{name: there[name] for name in order})
    mine, its = (p.simulate(law, [[0.0, 0.0]], time=3.0)["simulation"] for law in (held, None))
    assert words(mine) == words(its)
    assert mine.events.values.tolist() == its.events.values.tolist()
    np.testing.assert_allclose(mine.x_end, its.x_end, atol=1e-9)


def test_points_of_flights_that_end_early():
    p = pycostate.Problem(
        states=["x"],
        controls=["u"],
        dynamics={"x": "x^2 + u"},
        running="u^2",
        terminal="0",
        final_time=5,
        region={"x": [0, 1]},
    )
    tree = p.simulate(held, [[0.5]], samples=10)
    flown, t = tree["simulation"], tree["simulation_samples"].t.values
    assert flown.t_end.item() == pytest.approx(2.0, abs=1e-5)
    np.testing.assert_allclose(t, np.linspace(0.0, flown.t_end.item(), 11), atol=1e-9)
