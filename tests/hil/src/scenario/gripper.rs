//! The gripper of the simulated cell: a parallel gripper with three mark plates.

use graspd_calib::files::{Finger, GripperFile, OrientedBox};
use graspd_rt::geom::{Pose, Vec3};
use graspd_rt::gripper::{Gripper, Mark};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion};

/// Inclination of the mark plates about x towards +y, rad: a rotation about the approach axis then changes the images.
const PLATE_INCLINATION_RAD: f64 = 35.0 * std::f64::consts::PI / 180.0;
/// Radius of the marks, m.
const MARK_RADIUS_M: f64 = 0.008;
/// Half the thickness of the plates, m.
const HALF_PLATE_M: f64 = 0.002;

/// A gripper with nine dark marks on two light wings and on a light tongue near the jaws; the pattern has no symmetry.
///
/// The tongue is 26 mm in front of the plane of the wings. Marks at two depths make the pose well conditioned, and
/// marks near the jaws make it insensitive to calibration errors.
pub fn default_gripper() -> GripperFile {
    let plate = |x: f64, y: f64, z: f64| {
        Isometry3::from_parts(
            Translation3::new(x, y, z),
            UnitQuaternion::from_euler_angles(PLATE_INCLINATION_RAD, 0.0, 0.0),
        )
    };
    let wings = [plate(0.094, 0.050, -0.075), plate(-0.094, 0.050, -0.075)];
    let tongue = plate(0.0, 0.055, -0.040);
    let mut gripper = Gripper { marks: Default::default(), flange_from_gripper: Pose::translation(0.0, 0.0, 0.165) };
    let mut put = |p: &Pose, spots: &[(f64, f64)]| {
        for (u, v) in spots {
            // The outer face of a plate is its -z face.
            let position = (p * Point3::new(*u, *v, -HALF_PLATE_M)).coords;
            let _ = gripper.marks.push(Mark {
                position,
                normal: p.rotation * -Vec3::z(),
                radius: MARK_RADIUS_M,
                dark: true,
            });
        }
    };
    put(&wings[0], &[(-0.014, -0.031), (0.014, -0.009), (-0.013, 0.012), (0.011, 0.033)]);
    put(&wings[1], &[(0.012, -0.030), (-0.013, 0.003), (0.010, 0.031)]);
    put(&tongue, &[(-0.018, 0.004), (0.015, -0.007)]);
    let solid = |pose: Pose, x: f64, y: f64, z: f64| OrientedBox { frame_from_box: pose, half: Vec3::new(x, y, z) };
    let at = |x: f64, y: f64, z: f64| Pose::translation(x, y, z);
    let finger = |side: f64| Finger { side, closed: solid(at(side * 0.008, 0.0, -0.022), 0.008, 0.012, 0.034) };
    GripperFile {
        gripper,
        name: Some("simulated parallel gripper, three mark plates".into()),
        opening: [0.0, 0.170],
        finger_length: 0.050,
        fingers: vec![finger(1.0), finger(-1.0)],
        body: vec![
            solid(at(0.0, 0.0, -0.1205), 0.045, 0.032, 0.0425),
            solid(at(0.0, 0.0, -0.067), 0.104, 0.014, 0.010),
            solid(wings[0], 0.029, 0.045, HALF_PLATE_M),
            solid(wings[1], 0.029, 0.045, HALF_PLATE_M),
            solid(tongue, 0.031, 0.020, HALF_PLATE_M),
        ],
    }
}
