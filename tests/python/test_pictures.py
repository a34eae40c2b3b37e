"""Pictures: what is drawn is what was computed."""

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pycostate
import pytest


@pytest.fixture(autouse=True)
def close():
    yield
    plt.close("all")


@pytest.fixture
def swept(double_integrator):
    p = double_integrator.having(shoot_out={"value_max": 0.5, "spacing": 0.2, "samples": 10})
    return p.sweep()


def test_contours(double_integrator):
    m = double_integrator.map(error=1e-3, counts=21)
    ax = m.costate.contours(levels=[0.1, 0.2, 0.4, 0.8])
    assert ax.get_xlabel() == "x (m)" and ax.get_ylabel() == "v (m/s)"
    filled = ax.collections[0]
    np.testing.assert_allclose(filled.levels, [0.1, 0.2, 0.4, 0.8])
    with pytest.raises(pycostate.InputError, match="is no axis"):
        m.costate.contours(y=0.0)


def test_sheets_are_parted(scenarios):
    p = pycostate.Problem.load(scenarios / "pendulum.toml").using(backend="cpu")
    ds = p.solve(theta=np.linspace(-4.0, 2.5, 14), omega=np.linspace(-3, 3, 7))
    assert len(np.unique(ds.sheet)) > 1
    ax = ds.costate.contours()
    changes = ax.collections[-1].get_segments()
    # One line between each pair of neighbours with different sheets.
    sheet = ds.sheet.where(ds.V.notnull())
    pairs = 0
    for dim in ("theta", "omega"):
        a, b = sheet.isel({dim: slice(1, None)}).values, sheet.isel({dim: slice(None, -1)}).values
        pairs += (np.isfinite(a) & np.isfinite(b) & (a != b)).sum()
    assert len(changes) == pairs > 0
    ax = ds.costate.slice(omega=0.0)
    lines = {line.get_label(): line for line in ax.lines}
    drawn = sum(np.isfinite(line.get_ydata()).sum() for line in lines.values())
    assert drawn == ds.V.sel(omega=0.0).notnull().sum()
    assert ds.costate.slice("u", omega=0.0).get_ylabel() == "torque u (N m)"
    assert ds.costate.slice("p_theta", omega=0.0).get_ylabel() == "p_theta"
    with pytest.raises(pycostate.InputError, match="neither V"):
        ds.costate.slice("w", omega=0.0)


def test_phase_and_histories(swept):
    ax = swept.costate.phase()
    (pieces,) = ax.collections
    assert len(pieces.get_segments()) > 50
    assert np.nanmax(pieces.get_array()) <= 0.51
    panels = swept.costate.histories(count=3)
    assert len(panels) == 3 and all(len(panel.lines) == 3 for panel in panels)
    assert panels[0].get_ylabel() == "x (m)"
    with pytest.raises(pycostate.InputError, match="is no state"):
        swept.costate.phase(("x", "w"))
    assert "trajectories" in swept.costate.file.children


def test_flights_are_drawn_by_phase(ball):
    tree = ball("-0.8*v").simulate(h=1.0, v=0.0, time=1.5)
    samples = tree["simulation_samples"].to_dataset()
    panels = samples.costate.histories()
    assert len(panels[0].lines) == tree["simulation_events"].sizes["jump"] + 1
    assert len(samples.costate.phase().lines) == len(panels[0].lines)


def test_what_has_no_picture_is_said(double_integrator, swept):
    points = double_integrator.solve([[0.1, 0.2], [0.3, 0.1]])
    with pytest.raises(pycostate.InputError, match="no grid"):
        points.costate.contours()
    with pytest.raises(pycostate.InputError, match="no grid"):
        swept.costate.contours()
    with pytest.raises(pycostate.InputError, match="no trajectories"):
        points.costate.phase()


def test_levels_are_the_report_s(double_integrator):
    m = double_integrator.map(error=1e-3)
    ax = m.costate.contours()
    filled = ax.collections[0]
    most = float(m.V.max())
    inner = [level for level in filled.levels if 0 < level < most]
    assert inner and all(f"{level:e}"[0] in "125" for level in inner)
    assert filled.levels[-1] == pytest.approx(most) and ax.get_title() == "V"
    # The local solution about the equilibrium is no sheet of its own: no lines of changes.
    assert (m.sheet.values < 0).any() and len(ax.collections) == 2
    assert ax.texts
    ax = m.costate.contours("u", levels=5)
    assert len(ax.collections[0].levels) == 6
    line = m.costate.slice("V", v=0.0)
    assert line.get_legend() is None
    with pytest.raises(pycostate.InputError, match="levels"):
        m.costate.contours(levels=[float("nan"), 1.0])


def test_nodes_have_pictures(double_integrator):
    tree = double_integrator.simulate("lqr", [0.5, 0.2], time=3.0)
    axes = tree["simulation_samples"].costate.histories()
    assert len(axes) == 3 and len(axes[0].lines) == 1
