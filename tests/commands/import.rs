//! `costate import`: a robot's file to a scene that the other commands take.

use crate::common_commands::{costate, done, scratch};

/// Two links that turn about y, as a robot's maker would write them.
const ROBOT: &str = r#"<robot name="two links">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0 0 0.25"/><mass value="2"/>
    <inertia ixx="0.04" ixy="0" ixz="0" iyy="0.04" iyz="0" izz="0.001"/></inertial></link>
  <link name="fore"><inertial><origin xyz="0 0 0.2"/><mass value="1"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.001"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="60" velocity="8"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0 0 0.5"/><axis xyz="0 1 0"/>
    <limit lower="-2.5" upper="2.5" effort="30" velocity="8"/></joint>
</robot>"#;

#[test]
fn a_robot_is_solved_for() {
    let folder = scratch("import");
    let (robot, scene) = (folder.join("robot.urdf"), folder.join("robot.toml"));
    std::fs::write(&robot, ROBOT).unwrap();
    let [robot, scene] = [robot, scene].map(|p| p.display().to_string());
    let said = done(costate(&["import", &robot, "--out", &scene]));
    assert!(said.contains("2 joints, 3 kg"), "{said}");
    // Not again: what is there may be somebody's work.
    let again = costate(&["import", &robot, "--out", &scene]);
    assert_eq!(again.status.code(), Some(2));
    let text = String::from_utf8_lossy(&again.stderr).into_owned();
    assert!(text.contains("is there already"), "{text}");
    // Upright: it is held without torques, and V is that of the scene.
    let checked = done(costate(&["check", &scene]));
    assert!(checked.contains("Riccati solution"), "{checked}");
    let points = folder.join("points.csv");
    std::fs::write(&points, "shoulder,elbow\n0.1,-0.05\n").unwrap();
    let out = folder.join("robot.h5").display().to_string();
    let points = points.display().to_string();
    let solved = done(costate(&[
        "solve",
        &scene,
        "--points",
        &points,
        "--out",
        &out,
        "--backend",
        "cpu",
    ]));
    assert!(solved.contains("1 converged"), "{solved}");
}

#[test]
fn what_is_no_robot_writes_nothing() {
    let folder = scratch("import_refused");
    let robot = folder.join("robot.urdf").display().to_string();
    let scene = folder.join("scene.toml").display().to_string();
    let refused = |text: &str, arguments: &[&str], words: &str| {
        std::fs::write(&robot, text).unwrap();
        let done = costate(&[&["import"], arguments].concat());
        let said = String::from_utf8_lossy(&done.stderr);
        assert_eq!(done.status.code(), Some(2), "{said}");
        assert!(said.contains(words), "{said}");
        assert!(!folder.join("scene.toml").exists());
    };
    refused("<robot", &[&robot, "--out", &scene], "no URDF");
    refused(ROBOT, &[&robot, "--out", &robot], "this file is read");
    refused(ROBOT, &[&robot, "--out", "scene.h5"], "name it .toml");
    refused(
        ROBOT,
        &["nothing.urdf", "--out", &scene],
        "cannot read nothing.urdf",
    );
    let weightless = ROBOT
        .replace("mass value=\"1\"", "mass value=\"0\"")
        .replace("0.01\"", "0\"");
    refused(&weightless, &[&robot, "--out", &scene], "moves no mass");
}
