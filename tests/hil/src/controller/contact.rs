//! A plane that the tool can touch.

use nalgebra::Vector3;

/// A plane that the TCP can touch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactPlane {
    /// A point of the plane, base frame, m.
    pub point: [f64; 3],
    /// Normal towards the free side.
    pub normal: [f64; 3],
    /// Contact stiffness, N/m.
    pub stiffness: f64,
}

impl ContactPlane {
    /// A plane with a unit normal.
    ///
    /// # Errors
    /// A number is not finite, the normal is zero or the stiffness is not positive.
    pub(super) fn new(point: [f64; 3], normal: [f64; 3], stiffness: f64) -> Result<Self, String> {
        let n = Vector3::from(normal).try_normalize(1e-9).filter(|n| n.iter().all(|x| x.is_finite()));
        match n {
            Some(n) if point.iter().all(|x| x.is_finite()) && stiffness > 0.0 && stiffness <= MAX_STIFFNESS => {
                Ok(ContactPlane { point, normal: n.into(), stiffness })
            }
            _ => {
                Err(format!("a contact plane needs finite numbers, a normal and a stiffness up to {MAX_STIFFNESS} N/m"))
            }
        }
    }
}

/// Largest contact stiffness, N/m: the force loop is stable up to twice this value.
const MAX_STIFFNESS: f64 = 5000.0;
