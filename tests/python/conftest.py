"""What the tests of pycostate share. They run on an installed wheel: tests/python.sh."""

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def scenarios():
    return ROOT / "scenarios"


@pytest.fixture
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
