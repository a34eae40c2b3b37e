"""What the tests of pycostate share. They run on an installed wheel: tests/python.sh."""

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def scenarios():
    return ROOT / "scenarios"


@pytest.fixture(scope="session")
def double_integrator():
    import pycostate

    # V = x'Px/2 with P = [[sqrt(2), 1], [1, sqrt(2)]].
    return pycostate.Problem(
        title="Double integrator",
        states={"x": {"unit": "m"}, "v": {"unit": "m/s"}},
        controls=["u"],
        dynamics={"x": "v", "v": "u"},
        running="0.5*(x^2 + u^2)",
        equilibrium={"x": 0, "v": 0, "u": 0},
        region={"x": [-1, 1], "v": [-1, 1]},
        integrator={"rtol": 1e-10},
    ).using(backend="cpu")


@pytest.fixture
def ball():
    """A ball on a floor; `set` says what a bounce makes of its speed."""
    import pycostate

    def made(set):
        return pycostate.Problem(
            states=["h", "v"],
            controls=["u"],
            dynamics={"h": "v", "v": "-9.81 + u"},
            running="u^2",
            terminal="0",
            final_time=1,
            region={"h": [0, 2], "v": [-6, 6]},
            events={"floor": {"when": "h <= 0", "set": {"v": set}}},
        ).using(backend="cpu")

    return made
