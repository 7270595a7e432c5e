//! The arm's poses and Jacobians compared with values of an independent library.
//!
//! `data/make_kinematics.py` generated `data/kinematics_pin.csv` with Pinocchio; it documents the columns.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_rt::arm::{Dh, Joints, Model};
use graspd_rt::geom::Pose;

#[test]
fn poses_and_jacobians_agree_with_pinocchio() {
    let table = include_str!("data/kinematics_pin.csv");
    let mut rows = 0;
    for line in table.lines() {
        let mut cells = line.split(',');
        let name = cells.next().unwrap();
        let v: Vec<f64> = cells.map(|c| c.parse().unwrap()).collect();
        assert_eq!(v.len(), 6 + 3 + 9 + 36);
        let dh = Dh::nominal(Model::from_name(name).unwrap());
        let q: Joints = v[0..6].try_into().unwrap();
        let pose = dh.base_from_flange(&q);
        let r = pose.rotation.to_rotation_matrix();
        for i in 0..3 {
            assert!((pose.translation.vector[i] - v[6 + i]).abs() < 1e-10, "{name}");
            for j in 0..3 {
                assert!((r[(i, j)] - v[9 + 3 * i + j]).abs() < 1e-10, "{name}");
            }
        }
        let jac = dh.body_jacobian(&q, &Pose::identity());
        for i in 0..6 {
            for j in 0..6 {
                assert!((jac[(i, j)] - v[18 + 6 * i + j]).abs() < 1e-10, "{name} {i} {j}");
            }
        }
        rows += 1;
    }
    assert_eq!(rows, 54, "six positions of each of nine models");
}
