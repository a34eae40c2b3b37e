use super::*;

const ARM: &str = r#"<?xml version="1.0"?>
<robot name="arm">
  <link name="base"><inertial><mass value="5"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="upper">
    <inertial>
      <origin xyz="0 0 0.2" rpy="0 0 1.5707963267948966"/>
      <mass value="2"/>
      <inertia ixx="0.03" ixy="0.001" ixz="0" iyy="0.02" iyz="0" izz="0.004"/>
    </inertial>
    <visual><geometry><box size="1 1 1"/></geometry></visual>
  </link>
  <link name="fore">
    <inertial><origin xyz="0.15 0 0"/><mass value="1"/><inertia ixx="0.001" ixy="0" ixz="0" iyy="0.008" iyz="0" izz="0.008"/></inertial>
  </link>
  <link name="tool"/>
  <joint name="shoulder pan" type="revolute">
    <parent link="base"/><child link="upper"/><origin xyz="0 0 0.1" rpy="0 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="2" effort="50" velocity="3"/><dynamics damping="0.5" friction="0.1"/>
  </joint>
  <joint name="elbow" type="continuous">
    <parent link="upper"/><child link="fore"/><origin xyz="0 0 0.4" rpy="0 1.5707963267948966 0"/><axis xyz="0 1 0"/>
  </joint>
  <joint name="flange" type="fixed"><parent link="fore"/><child link="tool"/><origin xyz="0.3 0 0"/></joint>
</robot>"#;

#[test]
fn a_robot_becomes_a_scene() {
    let made = import(ARM, "arm.urdf").unwrap();
    assert_eq!((made.joints, made.mass), (2, 3.0));
    let said = made.notes.join("; ");
    for words in [
        "shoulder_pan",
        "Coulomb friction",
        "its mass plays no part",
        "look",
    ] {
        assert!(said.contains(words), "{words}: {said}");
    }
    let scene = Scene::parse(&made.text, "arm.toml").unwrap();
    let names: Vec<&str> = scene
        .model
        .states
        .iter()
        .map(|s| s.variable.name.as_str())
        .collect();
    assert_eq!(
        names,
        ["shoulder_pan", "elbow", "shoulder_pan_rate", "elbow_rate"]
    );
    assert_eq!(scene.model.controls[0].max, Some(50.0));
    assert_eq!(scene.model.guards.len(), 4);

    // Written by hand: the tensor turned by a right angle about z, heights from sines and cosines.
    let at = MechanismAt::new(&scene).unwrap();
    let (q1, q2) = (0.3, -0.4);
    let found = at.at(&[q1, q2, 0.0, 0.0], &[0.0, 0.0], &[]);
    // Both about y: the upper arm along z, the fore arm along its x, which points down at 0.
    let about = [0.03 + 2.0 * 0.04, 0.008 + 0.15f64.powi(2)];
    let way = 0.4f64;
    // The fore arm's centre in the upper arm's frame.
    let (x, z) = (-0.15 * q2.sin(), way - 0.15 * q2.cos());
    let m22 = about[1];
    let m11 = about[0] + 0.008 + x * x + z * z;
    let m12 = 0.008 + x * (-0.15 * q2.sin()) + (z - way) * (z);
    assert!(
        (found.mass_matrix[1][1] - m22).abs() < 1e-12,
        "{:?}",
        found.mass_matrix
    );
    assert!(
        (found.mass_matrix[0][0] - m11).abs() < 1e-12,
        "{:?} {m11}",
        found.mass_matrix
    );
    assert!(
        (found.mass_matrix[0][1] - m12).abs() < 1e-12,
        "{:?} {m12}",
        found.mass_matrix
    );
    assert_eq!(found.points.len(), 1);
}

#[test]
fn a_robot_that_floats_has_no_equilibrium() {
    let floating = ARM.replace("type=\"continuous\"", "type=\"floating\"");
    let made = import(&floating, "arm.urdf").unwrap();
    assert!(made.notes.join("; ").contains("no equilibrium"));
    let scene = Scene::parse(&made.text, "arm.toml").unwrap();
    assert_eq!(scene.model.states.len(), 14);
    assert!(scene.model.final_time().is_some());
}

#[test]
fn a_motor_that_is_too_weak_holds_nothing() {
    let lying =
        (ARM.replace("effort=\"50\"", "effort=\"0.5\"")).replace("rpy=\"0 0 0\"", "rpy=\"0 1 0\"");
    let made = import(&lying, "arm.urdf").unwrap();
    let said = made.notes.join("; ");
    assert!(said.contains("cannot hold"), "{said}");
    let scene = Scene::parse(&made.text, "arm.toml").unwrap();
    assert_eq!(scene.model.controls[0].max, Some(0.5));
    assert!(scene.model.final_time().is_some());
    let odd = ARM.replace("lower=\"-1\" upper=\"2\"", "lower=\"2\" upper=\"-1\"");
    let said = import(&odd, "arm.urdf").unwrap().notes.join("; ");
    assert!(said.contains("limits that are no limits"), "{said}");
}

#[test]
fn what_is_no_robot_is_refused() {
    let refused = |text: &str, words: &str| {
        let error = import(text, "arm.urdf").unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
    };
    refused("<robot", "no URDF");
    refused("hello", "no URDF");
    let nested = format!(
        "<robot>{}{}</robot>",
        "<a>".repeat(20000),
        "</a>".repeat(20000)
    );
    refused(&nested, "nested");
    refused("<robot name=\"r\"/>", "no link");
    let twice = ARM.replace("<link name=\"tool\"/>", "<link name=\"fore\"/>");
    refused(&twice, "two links are called `fore`");
    refused("<robot xmlns:xacro=\"x\"></robot>", "xacro");
    refused("<robot name=\"r\"><link name=\"a\"/></robot>", "no joint");
    refused(
        &ARM.replace("child link=\"fore\"", "child link=\"four\""),
        "no link `four`",
    );
    refused(
        &ARM.replace("type=\"continuous\"", "type=\"planar\""),
        "planar",
    );
    refused(
        &ARM.replace("axis xyz=\"0 1 0\"", "axis xyz=\"0 0 0\""),
        "axis",
    );
    refused(
        &ARM.replace("<mass value=\"1\"/>", "<mass value=\"0\"/>")
            .replace("0.008", "0"),
        "moves no mass",
    );
    refused(
        &ARM.replace("parent link=\"base\"", "parent link=\"tool\""),
        "circle",
    );
    refused(
        &ARM.replace("mass value=\"2\"", "mass value=\"inf\""),
        "finite",
    );
}

#[test]
fn what_a_robot_leaves_open_is_said() {
    let said = |text: &str| import(text, "arm.urdf").unwrap();
    // The continuous joint repeats, and has no limits of rate and force.
    let made = said(ARM);
    assert!(
        made.text
            .contains("elbow = { unit = \"rad\", period = \"2*pi\" }")
    );
    let notes = made.notes.join("\n");
    for words in [
        "no limit of velocity (missing, 0 or infinite, which is taken for none): elbow",
        "no limit of effort",
    ] {
        assert!(notes.contains(words), "{words}: {notes}");
    }
    assert!(!notes.contains("no limit of position"), "{notes}");
    let zero = ARM.replace("lower=\"-1\" upper=\"2\"", "lower=\"0\" upper=\"0\"");
    let notes = said(&zero).notes.join("\n");
    assert!(
        notes.contains(
            "no limit of position (missing, 0 or infinite, which is taken for none): shoulder pan"
        ),
        "{notes}"
    );
    let bare = ARM.replace(" effort=\"50\" velocity=\"3\"", "");
    let notes = said(&bare).notes.join("\n");
    assert!(notes.contains("no limit of velocity (missing, 0 or infinite, which is taken for none): shoulder pan, elbow"), "{notes}");
    let more = ARM.replace("</robot>", "<transmission name=\"t\"/><gazebo/></robot>");
    let notes = said(&more).notes.join("\n");
    assert!(
        notes.contains("transmissions") && notes.contains("Gazebo"),
        "{notes}"
    );
    // What no body has is taken as it is, and written so.
    let odd = ARM.replace("izz=\"0.004\"", "izz=\"0.4\"");
    let made = said(&odd);
    let notes = made.notes.join("\n");
    assert!(
        notes.contains("no body has the inertia of upper"),
        "{notes}"
    );
    assert!(!made.text.contains("-0.0,") && !made.text.contains("-0.0]"));
}

/// A joint that mimics another is where it is as the scene begins: against the same robot with that
/// joint moved there by hand.
#[test]
fn a_joint_that_mimics() {
    let joint = |rest: &str| {
        format!(
            "<link name=\"finger\"><inertial><origin xyz=\"0 0.1 0\"/><mass value=\"0.3\"/><inertia ixx=\"0.001\" ixy=\"0\" ixz=\"0\" iyy=\"0.002\" iyz=\"0\" izz=\"0.0025\"/></inertial></link>\
             <joint name=\"grip\" type=\"revolute\"><parent link=\"tool\"/><child link=\"finger\"/>{rest}</joint></robot>"
        )
    };
    let with = |rest: &str| import(&ARM.replace("</robot>", &joint(rest)), "arm.urdf");
    // The pan begins in the middle of limits that leave out 0.
    let limits = |text: String| text.replace("lower=\"-1\"", "lower=\"1\"");
    let mimics = joint(
        "<origin xyz=\"0 0 0.05\" rpy=\"0.3 0 0\"/><axis xyz=\"1 0 0\"/><limit lower=\"-1\" upper=\"1\" effort=\"1\" velocity=\"1\"/><mimic joint=\"shoulder pan\" multiplier=\"-0.5\" offset=\"0.25\"/>",
    );
    let made = import(&limits(ARM.replace("</robot>", &mimics)), "arm.urdf").unwrap();
    // -0.5 * 1.5 + 0.25 about x, after 0.3 about x.
    let moved = joint("<origin xyz=\"0 0 0.05\" rpy=\"-0.2 0 0\"/>")
        .replace("type=\"revolute\"", "type=\"fixed\"");
    let by_hand = import(&limits(ARM.replace("</robot>", &moved)), "arm.urdf").unwrap();
    let notes = made.notes.join("\n");
    assert!(
        notes.contains("joint `grip` mimics another one: it is fixed at -0.5"),
        "{notes}"
    );
    let [here, there] = [&made, &by_hand].map(|made| {
        let scene = Scene::parse(&made.text, "arm.toml").unwrap();
        let at = MechanismAt::new(&scene).unwrap();
        at.at(&[1.2, 0.4, 0.1, -0.2], &[0.0, 0.0], &[])
    });
    for (a, b) in here
        .mass_matrix
        .concat()
        .iter()
        .zip(there.mass_matrix.concat())
    {
        assert!((a - b).abs() < 1e-14, "{a} {b}");
    }
    for (a, b) in here.bias.iter().zip(&there.bias) {
        assert!((a - b).abs() < 1e-13, "{a} {b}");
    }
    let unknown = with("<axis xyz=\"1 0 0\"/><mimic joint=\"elbw\"/>").unwrap_err();
    assert!(unknown.to_string().contains("mimics `elbw`"), "{unknown}");
    let circle = with("<axis xyz=\"1 0 0\"/><mimic joint=\"grip\"/>").unwrap_err();
    assert!(circle.to_string().contains("circle"), "{circle}");
    let nothing = ARM.replace(
        "<inertia ixx=\"0.001\" ixy=\"0\" ixz=\"0\" iyy=\"0.008\" iyz=\"0\" izz=\"0.008\"/>",
        "",
    );
    let error = import(&nothing, "arm.urdf").unwrap_err().to_string();
    assert!(error.contains("link `fore` has no <inertia>"), "{error}");
}
