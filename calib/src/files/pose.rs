//! The record of a pose in a file.

use super::error::{FileError, Source};
use graspd_rt::geom::Pose;
use nalgebra::{Quaternion, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// A pose `a_from_b` in a file: a translation, and exactly one of a quaternion and a rotation vector.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PoseRecord {
    /// Translation, metres.
    pub translation_m: [f64; 3],
    /// Unit quaternion, scalar first.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub quaternion_wxyz: Option<[f64; 4]>,
    /// Rotation vector (axis times angle), radians.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rotation_vector_rad: Option<[f64; 3]>,
}

impl PoseRecord {
    /// The record of a pose, with the rotation as a quaternion whose scalar part is not negative.
    pub fn of(p: &Pose) -> Self {
        let q = p.rotation.quaternion();
        let s = if q.w < 0.0 { -1.0 } else { 1.0 };
        // Adding zero turns negative zero into zero, so that equal poses give equal bytes.
        Self {
            translation_m: [p.translation.x + 0.0, p.translation.y + 0.0, p.translation.z + 0.0],
            quaternion_wxyz: Some([s * q.w + 0.0, s * q.i + 0.0, s * q.j + 0.0, s * q.k + 0.0]),
            rotation_vector_rad: None,
        }
    }

    /// Checks the record and converts it to a pose. `limit_m` bounds each coordinate of the translation, metres.
    pub(super) fn pose(&self, src: &Source<'_>, key: &str, limit_m: f64) -> Result<Pose, FileError> {
        let t = src.vector(&format!("{key}.translation_m"), self.translation_m, limit_m, "metres")?;
        let rotation = match (self.quaternion_wxyz, self.rotation_vector_rad) {
            (Some([w, i, j, k]), None) => {
                let q = Quaternion::new(w, i, j, k);
                let n = q.norm();
                if !((n - 1.0).abs() < 1e-3) {
                    return Err(src.refuse(
                        &format!("{key}.quaternion_wxyz"),
                        [w, i, j, k],
                        format!("its length is {n:.6}, not 1"),
                        "give a unit quaternion, scalar first",
                    ));
                }
                // No normalisation if it is not needed: a written file is read back bit for bit.
                if (n - 1.0).abs() < 1e-14 {
                    UnitQuaternion::new_unchecked(q)
                } else {
                    UnitQuaternion::new_normalize(q)
                }
            }
            (None, Some(v)) => {
                let v: Vector3<f64> = src.vector(&format!("{key}.rotation_vector_rad"), v, 6.3, "radians")?;
                UnitQuaternion::from_scaled_axis(v)
            }
            (Some(_), Some(_)) => {
                return Err(src.refuse(
                    key,
                    "two rotations",
                    "both a quaternion and a rotation vector are given",
                    "remove one of them",
                ));
            }
            (None, None) => {
                return Err(src.refuse(
                    key,
                    "no rotation",
                    "the rotation is missing",
                    "add quaternion_wxyz = [1.0, 0.0, 0.0, 0.0] or rotation_vector_rad = [0.0, 0.0, 0.0]",
                ));
            }
        };
        Ok(Pose::from_parts(Translation3::from(t), rotation))
    }
}
