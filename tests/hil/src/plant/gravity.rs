//! Gravity torques of the joints from point masses: accurate enough for plausible currents and moments.

use super::{Joints, Kinematics};
use nalgebra::{Isometry3, Vector3};

/// Joint torques (Nm) that hold the links and a payload (kg, at the flange) against gravity, base upright. Each link is
/// a point mass at its middle.
pub fn gravity_torques(kinematics: &Kinematics, masses: &Joints, payload: f64, q: &Joints) -> Joints {
    let mut torque = [0.0; 6];
    // The middle of a link is the flange of a chain that ends after half of its a and d.
    for (link, own_mass) in masses.iter().enumerate() {
        let mut part = *kinematics;
        for row in &mut part.rows[link..] {
            (row.a, row.d) = (0.0, 0.0);
        }
        part.rows[link].a = kinematics.rows[link].a / 2.0;
        part.rows[link].d = kinematics.rows[link].d / 2.0;
        let mass = own_mass + if link == 5 { payload } else { 0.0 };
        let j = part.jacobian(q, &Isometry3::identity());
        let weight = Vector3::new(0.0, 0.0, mass * 9.82);
        for (joint, t) in torque.iter_mut().enumerate().take(link + 1) {
            *t += j.fixed_view::<3, 1>(0, joint).dot(&weight);
        }
    }
    torque
}

#[cfg(test)]
mod tests {
    use super::super::Model;
    use super::*;

    #[test]
    fn the_shoulder_torque_is_large_for_a_stretched_arm_and_small_for_an_upright_one() {
        let m = Model::by_name("ur5e").unwrap();
        let k = m.nominal();
        let out = gravity_torques(&k, &m.masses, 0.0, &[0.0; 6]);
        let up = gravity_torques(&k, &m.masses, 0.0, &[0.0, -std::f64::consts::FRAC_PI_2, 0.0, 0.0, 0.0, 0.0]);
        assert!(out[1].abs() > 40.0 && out[1].abs() < 150.0, "{out:?}");
        assert!(up[1].abs() < 15.0, "{up:?}");
        assert!(out[0].abs() < 1e-9);
    }
}
