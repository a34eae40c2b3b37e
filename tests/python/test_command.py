"""What only the command has."""

import pycostate
import pytest


def test_a_command_prints_and_fails():
    assert "[states]" in pycostate.command("reference", "scene")
    with pytest.raises(pycostate.InputError, match="nothing.toml"):
        pycostate.command("check", "nothing.toml")
    assert isinstance(pycostate.adapters(), list)


def test_the_least_is_asked_for(double_integrator):
    ds = double_integrator.solve(x=[0.2, -0.4], v=[0.1, 0.3])
    answer = pycostate.check_least(ds, nodes=61)
    assert answer["not_least"] is False
    assert len(answer) > 1


def test_speed_against_error(double_integrator):
    p = double_integrator.having(shoot_out={"value_max": 0.5, "spacing": 0.2, "samples": 10})
    tree = p.bench(backend="cpu", trajectories=64, precision="f64", method=["tsit5"], rtol=[1e-4, 1e-6])
    assert tree["speed_error"].to_dataset().sizes
    with pytest.raises(TypeError, match="speed"):
        p.bench(speed=1)


def test_a_mechanism(scenarios):
    p = pycostate.Problem.load(scenarios / "cart_pole_mechanism.toml")
    at = p.mechanism(pole=[0.1, 0.2])
    assert at["coordinates"] == ["cart", "pole"]
    one, other = (state["by_control"] for state in at["states"])
    assert one != other
    # A problem that is no file's.
    assert p.having(title="Another").mechanism()["states"] == p.mechanism()["states"]
    gait = pycostate.Problem.load(scenarios / "compass_gait.toml")
    assert "swing" in gait.set(slope=0.01).mechanism()["coordinates"]


def test_a_robot(tmp_path):
    robot = tmp_path / "arm.urdf"
    robot.write_text(
        """<robot name="arm"><link name="base"/>
        <link name="a"><inertial><origin xyz="0.5 0 0"/><mass value="1"/>
        <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
        <joint name="j" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>
        <limit lower="-1" upper="1" effort="20" velocity="3"/></joint></robot>"""
    )
    text = pycostate.import_urdf(robot)
    p = pycostate.Problem.parse(text)
    assert p.states == ("j", "j_rate")
    with pytest.raises(pycostate.InputError):
        pycostate.import_urdf(tmp_path / "none.urdf")
