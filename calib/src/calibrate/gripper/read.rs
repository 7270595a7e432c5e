//! Reads a recording in the JSON format of docs/CALIBRATION.md.

use super::data::{ArmPose, Noise, Recording, Sighting, Sigma};
use super::error::GripperError;
use super::raw::{Matrix4, RawCamera, RawNoise, RawPose, RawRecording, RawRig};
use super::rig_prior::{RIG_PARAMETERS, RigDeviations, RigPrior};
use crate::files::{GripperFile, RigFile};
use graspd_rt::geom::{Camera, Distortion, Pixel, Pose, Rig, Vec3};
use nalgebra::{DMatrix, Matrix3, Rotation3, Translation3, UnitQuaternion};
use std::path::Path;

/// Maximum size of a recording, bytes: 2000 poses of 32 marks take a fifth of it.
const MAX_FILE_BYTES: u64 = 64 << 20;
/// Maximum number of poses of a recording.
const MAX_POSES: usize = 2000;
/// Maximum number of marks of a gripper: the capacity of the servo loop.
const MAX_MARKS: usize = graspd_rt::gripper::MAX_MARKS;
/// Maximum deviation of a file's rotation matrix from orthonormality, per element of RᵀR: four digits.
const MAX_AXES_ERROR: f64 = 1e-3;
/// Minimum standard deviation that a stated zero is replaced by, for rounding: position 1 um (m), orientation 0.0001
/// degrees (rad), mark 0.001 px (px).
const MIN_SIGMA: [f64; 3] = [1e-6, 1.745e-6, 1e-3];

/// Reads and validates a recording. `rig`, if given, replaces the recording's own.
///
/// # Errors
/// A file that cannot be read, text that is not a JSON recording, or a value that is invalid for its key.
pub fn load(path: &Path, rig: Option<&RigFile>) -> Result<Recording, GripperError> {
    let name = path.display().to_string();
    let refuse = |reason: String| GripperError::Read { path: name.clone(), reason };
    let meta = std::fs::metadata(path).map_err(|e| refuse(e.to_string()))?;
    if !meta.is_file() {
        return Err(refuse("it is not a regular file".into()));
    }
    if meta.len() > MAX_FILE_BYTES {
        return Err(refuse(format!("it has {} bytes, the maximum is {MAX_FILE_BYTES}", meta.len())));
    }
    let text = std::fs::read_to_string(path).map_err(|e| refuse(e.to_string()))?;
    parse(&text, &name, rig)
}

/// Returns the gripper file embedded in a recording of `graspd calibrate record`.
///
/// # Errors
/// The recording has no gripper file, or an invalid one.
pub fn gripper_of(path: &Path) -> Result<GripperFile, GripperError> {
    let name = path.display().to_string();
    let refuse = |problem: String| {
        GripperError::Value {
        path: name.clone(),
        key: "gripper_toml".into(),
        problem,
        fix: "give a gripper file with --gripper: its openings, fingers and mark normals are kept, its mark positions and mounting replaced".into(),
    }
    };
    let text =
        std::fs::read_to_string(path).map_err(|e| GripperError::Read { path: name.clone(), reason: e.to_string() })?;
    let raw: RawRecording = serde_json::from_str(&text).map_err(|e| refuse(e.to_string()))?;
    let text = raw.gripper_toml.ok_or_else(|| refuse("the recording contains no gripper file".into()))?;
    GripperFile::parse(&text, "gripper_toml").map_err(|e| refuse(e.to_string()))
}

/// Parses and validates a recording given as text; `name` is the file name in errors.
///
/// # Errors
/// As [`load`].
pub fn parse(text: &str, name: &str, rig: Option<&RigFile>) -> Result<Recording, GripperError> {
    let raw: RawRecording = serde_json::from_str(text).map_err(|e| GripperError::Syntax {
        path: name.to_owned(),
        line: e.line(),
        column: e.column(),
        problem: e.to_string(),
    })?;
    Reader { name, unit: 1e-3 }.recording(raw, rig)
}

struct Reader<'a> {
    name: &'a str,
    /// Length unit of the file, metres.
    unit: f64,
}

impl Reader<'_> {
    fn refuse(&self, key: impl Into<String>, problem: impl Into<String>, fix: impl Into<String>) -> GripperError {
        GripperError::Value { path: self.name.to_owned(), key: key.into(), problem: problem.into(), fix: fix.into() }
    }

    fn recording(mut self, raw: RawRecording, given: Option<&RigFile>) -> Result<Recording, GripperError> {
        if let Some(kind) = raw.kind.as_deref().filter(|k| *k != "eye-to-hand") {
            let fix = "cameras mounted on the arm are not supported; record with fixed cameras (kind \"eye-to-hand\")";
            return Err(self.refuse("kind", format!("it is {kind:?}"), fix));
        }
        self.unit = match raw.units.as_ref().map(|u| u.length.as_str()) {
            None | Some("mm") => 1e-3,
            Some("m") => 1.0,
            Some(other) => {
                return Err(self.refuse(
                    "units.length",
                    format!("{other:?} is not a supported unit of length"),
                    "write mm or m",
                ));
            }
        };
        if !(4..=MAX_MARKS).contains(&raw.marks_mm.len()) {
            let problem = format!("{} marks", raw.marks_mm.len());
            return Err(self.refuse("marks_mm", problem, format!("a gripper has 4 to {MAX_MARKS}")));
        }
        let marks = raw.marks_mm.iter().enumerate();
        let marks = marks.map(|(k, m)| self.point(&format!("marks_mm[{k}]"), *m)).collect::<Result<Vec<_>, _>>()?;
        if raw.poses.is_empty() || raw.poses.len() > MAX_POSES {
            let problem = format!("{} poses", raw.poses.len());
            return Err(self.refuse("poses", problem, format!("record 1 to {MAX_POSES}")));
        }
        let (rig, rig_prior) = match (given, &raw.rig) {
            (Some(file), _) => (file.rig, file.quality.as_ref().map(|_| prior_of_file(file))),
            (None, Some(r)) => self.rig(r, raw.noise.as_ref())?,
            (None, None) => return Err(self.refuse("rig", "it is missing", "give one with --rig rig.toml")),
        };
        let poses = raw.poses.iter().enumerate();
        let poses = poses.map(|(i, p)| self.pose(i, p, marks.len())).collect::<Result<Vec<_>, _>>()?;
        let noise = self.noise(raw.noise.unwrap_or_default())?;
        let assumed = raw.assumed_flange_t_gripper.as_ref();
        let assumed = assumed.map(|m| self.transform("assumed_flange_T_gripper", m)).transpose()?;
        Ok(Recording { name: self.name.to_owned(), rig, rig_prior, marks, noise, poses, assumed })
    }

    fn point(&self, key: &str, p: [f64; 3]) -> Result<Vec3, GripperError> {
        let v = Vec3::from(p) * self.unit;
        if v.iter().all(|x| x.abs() < 1e3) {
            return Ok(v);
        }
        Err(self.refuse(key, format!("{p:?} is not a position within 1 km"), "give three finite numbers"))
    }

    fn transform(&self, key: &str, m: &Matrix4) -> Result<Pose, GripperError> {
        let last = m[3];
        if !(last[0].abs() + last[1].abs() + last[2].abs() + (last[3] - 1.0).abs() < 1e-9) {
            let transposed = (0..3).all(|r| m[r][3] == 0.0);
            let why = if transposed { "; it looks transposed, with the translation in the last row" } else { "" };
            return Err(self.refuse(
                key,
                format!("its last row is {last:?}{why}"),
                "write 4 rows, the last one 0, 0, 0, 1",
            ));
        }
        let r = Matrix3::from_fn(|i, j| m[i][j]);
        let off = (r.transpose() * r - Matrix3::identity()).amax();
        if !(off < MAX_AXES_ERROR) {
            let fix = "write orthonormal axes in columns; convert a rotation vector or Euler angles to a matrix first";
            return Err(self.refuse(key, format!("its axes are not orthonormal (by {off:.2e})"), fix));
        }
        if r.determinant() < 0.0 {
            return Err(self.refuse(
                key,
                "its axes are left-handed: a reflection, not a rotation",
                "check the signs of the axes",
            ));
        }
        let q = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&r));
        let t = self.point(key, [m[0][3], m[1][3], m[2][3]])?;
        Ok(Pose::from_parts(Translation3::from(t), q))
    }

    fn rig(&self, r: &RawRig, noise: Option<&RawNoise>) -> Result<(Rig, Option<RigPrior>), GripperError> {
        let right_from_left = self.transform("rig.right_T_left", &r.right_t_left)?;
        if right_from_left.translation.vector.norm() < 1e-4 {
            return Err(self.refuse(
                "rig.right_T_left",
                "both cameras have the same position",
                "give the stereo translation",
            ));
        }
        let left = self.camera("rig.left", &r.left, r.image_size)?;
        let right = self.camera("rig.right", &r.right, r.image_size)?;
        let rig = Rig { left, right, right_from_left };
        if let Some(rows) = &r.covariance {
            let problem = format!("not a covariance of {RIG_PARAMETERS} parameters");
            let fix = "symmetric, positive semidefinite, in the order of docs/CALIBRATION.md, in the file's unit of length and rad";
            let square = rows.len() == RIG_PARAMETERS && rows.iter().all(|row| row.len() == RIG_PARAMETERS);
            // Only the three translation parameters are lengths in the file's unit.
            let unit = |i: usize| if i >= 21 { self.unit } else { 1.0 };
            let c = DMatrix::from_fn(if square { RIG_PARAMETERS } else { 0 }, RIG_PARAMETERS, |i, j| {
                rows[i][j] * unit(i) * unit(j)
            });
            let prior = RigPrior::from_covariance(&c).ok_or_else(|| self.refuse("rig.covariance", problem, fix))?;
            return Ok((rig, Some(prior)));
        }
        let Some(s) = noise.and_then(|n| n.rig.as_ref()) else { return Ok((rig, None)) };
        for (key, v) in [("focal_px", s.focal_px), ("principal_px", s.principal_px), ("rotation_deg", s.rotation_deg)] {
            if !(0.0..=100.0).contains(&v) {
                return Err(self.refuse(
                    format!("noise.rig.{key}"),
                    format!("{v} is not a valid standard deviation"),
                    "give 0 to 100",
                ));
            }
        }
        let rotation_rad = s.rotation_deg.to_radians();
        let d = RigDeviations {
            focal_px: s.focal_px,
            aspect_px: 0.1 * s.focal_px,
            principal_px: s.principal_px,
            rotation_rad,
            baseline: s.baseline_relative,
            direction_rad: rotation_rad,
        };
        Ok((rig, Some(RigPrior::from_deviations(&d, &rig))))
    }

    fn camera(&self, key: &str, c: &RawCamera, size: Option<[u32; 2]>) -> Result<Camera, GripperError> {
        if let Some(m) = c.model.as_deref().filter(|m| *m != "opencv" && *m != "brown") {
            return Err(self.refuse(format!("{key}.model"), format!("{m:?} is not supported"), "use the OpenCV model"));
        }
        if !matches!(c.d.len(), 0 | 4 | 5 | 8) {
            let problem = format!("{} coefficients", c.d.len());
            return Err(self.refuse(format!("{key}.D"), problem, "give k1 k2 p1 p2 [k3 [k4 k5 k6]]"));
        }
        let d = |i: usize| c.d.get(i).copied().unwrap_or(0.0);
        let distortion = Distortion { k1: d(0), k2: d(1), p1: d(2), p2: d(3), k3: d(4), k4: d(5), k5: d(6), k6: d(7) };
        let [cx, cy] = [c.k[0][2], c.k[1][2]];
        // Without a stated size, the principal point is taken as the image centre.
        let [width, height] =
            size.unwrap_or([(2.0 * cx).clamp(1.0, 65_535.0) as u32, (2.0 * cy).clamp(1.0, 65_535.0) as u32]);
        if c.k[0][1].abs() > 1e-9 || c.k[2] != [0.0, 0.0, 1.0] || c.k[1][0] != 0.0 {
            return Err(self.refuse(
                format!("{key}.K"),
                "it has skew or is transposed",
                "give fx 0 cx, 0 fy cy, 0 0 1",
            ));
        }
        let camera = Camera { width, height, fx: c.k[0][0], fy: c.k[1][1], cx, cy, distortion };
        camera.validated().map_err(|e| {
            self.refuse(
                key,
                format!("not a valid camera ({e:?})"),
                "check K (pixels), D (OpenCV's order) and image_size",
            )
        })
    }

    fn pose(&self, i: usize, p: &RawPose, marks: usize) -> Result<ArmPose, GripperError> {
        let base_from_flange = self.transform(&format!("poses[{i}].base_T_flange"), &p.base_t_flange)?;
        let tcp = p.base_t_tcp.as_ref();
        let base_from_tcp = tcp.map(|m| self.transform(&format!("poses[{i}].base_T_tcp"), m)).transpose()?;
        let mut seen = Vec::with_capacity(p.marks.len());
        let mut taken = vec![false; marks];
        for (k, s) in p.marks.iter().enumerate() {
            let key = format!("poses[{i}].marks[{k}]");
            if s.mark >= marks {
                let problem = format!("mark {} of {marks}", s.mark);
                return Err(self.refuse(key, problem, "number the marks from 0, as in marks_mm"));
            }
            if std::mem::replace(&mut taken[s.mark], true) {
                return Err(self.refuse(
                    key,
                    format!("mark {} appears a second time", s.mark),
                    "list each mark once per pose",
                ));
            }
            let mut px = [None; 2];
            for (to, from) in px.iter_mut().zip([s.left, s.right]) {
                if let Some(v) = from {
                    if !v.iter().all(|x| x.abs() < 1e6) {
                        return Err(self.refuse(
                            key,
                            format!("{v:?} is not a pixel"),
                            "write null if the mark is hidden",
                        ));
                    }
                    *to = Some(Pixel::new(v[0], v[1]));
                }
            }
            seen.push(Sighting { mark: s.mark, px });
        }
        Ok(ArmPose { base_from_flange, base_from_tcp, joints: p.joints_rad, marks: seen })
    }

    fn noise(&self, n: RawNoise) -> Result<Noise, GripperError> {
        let d = Noise::default();
        let take = |key: &str, v: Option<f64>, unit: f64, least: f64, default: Sigma| match v {
            None => Ok(default),
            Some(v) if (0.0..1e6).contains(&v) => Ok(Sigma { value: (v * unit).max(least), stated: true }),
            Some(v) => Err(self.refuse(
                format!("noise.{key}"),
                format!("{v} is not a valid standard deviation"),
                "give 0 or more",
            )),
        };
        let outliers = n.outlier_fraction.unwrap_or(d.outliers);
        if !(0.0..=0.5).contains(&outliers) {
            let problem = format!("{outliers} is not a valid fraction");
            return Err(self.refuse("noise.outlier_fraction", problem, "give 0 to 0.5"));
        }
        Ok(Noise {
            flange_m: take("flange_mm", n.flange_mm, self.unit, MIN_SIGMA[0], d.flange_m)?,
            flange_rad: take("flange_deg", n.flange_deg, 1_f64.to_radians(), MIN_SIGMA[1], d.flange_rad)?,
            mark_px: take("mark_px", n.mark_px, 1.0, MIN_SIGMA[2], d.mark_px)?,
            marks_m: take("mark_model_mm", n.mark_model_mm, self.unit, 0.0, d.marks_m)?,
            outliers,
        })
    }
}

/// The error that a rig file states, as a prior. It states the common error of the focal lengths and half their
/// difference.
fn prior_of_file(file: &RigFile) -> RigPrior {
    let (e, rig) = (file.error(), &file.rig);
    let d = RigDeviations {
        focal_px: 0.0,
        aspect_px: 0.0,
        principal_px: e.principal_px,
        rotation_rad: e.rotation_rad,
        baseline: 0.0,
        direction_rad: e.rotation_rad,
    };
    let rest = RigPrior::from_deviations(&d, rig).factor;
    let mut factor = rest.insert_columns(0, 3, 0.0);
    let [l, r] = [rig.left.fx, rig.right.fx];
    for (column, left, right) in [(0, e.focal, e.focal), (1, -e.focal_difference, e.focal_difference)] {
        for row in [0, 1] {
            factor[(row, column)] = left * l;
            factor[(9 + row, column)] = right * r;
        }
    }
    // The printed size of a target is known to about the relative error of the focal lengths at best.
    let t = rig.right_from_left.translation.vector * e.focal;
    (0..3).for_each(|i| factor[(21 + i, 2)] = t[i]);
    RigPrior { factor }
}
