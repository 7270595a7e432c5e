//! A cell as a folder: the integrator's files and the ground truth.
//!
//! graspd may read `rig.toml`, `gripper.toml`, `arm.toml` (kinematics that it is given) and `clicks.json`.
//! `truth.toml`, `true_rig.toml` and `true_arm.toml` (kinematics of the mock controller) are for the simulators only.

use super::Scenario;
use crate::scene::{Sensor, Stage};
use graspd_calib::files::{FileError, GripperFile, PoseRecord, RigFile};
use graspd_rt::arm::{Dh, Joints, Model};
use graspd_rt::geom::{Pixel, Pose};
use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// A world cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum WorldError {
    /// A file cannot be read or written.
    #[error("world file {path}: {reason}; --world expects a folder written by `graspd-scene --make-world`")]
    File {
        /// The file.
        path: PathBuf,
        /// The system's error.
        reason: std::io::Error,
    },
    /// A file has wrong content.
    #[error("world file {path}: {reason}")]
    Parse {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The rig or gripper file is invalid.
    #[error(transparent)]
    Calibration(Box<FileError>),
}

impl From<FileError> for WorldError {
    fn from(e: FileError) -> Self {
        Self::Calibration(Box::new(e))
    }
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct TruthFile {
    schema: String,
    seed: u64,
    model: String,
    start_rad: Joints,
    grasp_turn_rad: f64,
    clicks: [[f64; 2]; 2],
    base_from_left: PoseRecord,
    base_from_object: PoseRecord,
    sensor: Sensor,
    stage: Stage,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ArmFile {
    model: String,
    dh: DhRecord,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct DhRecord {
    a: [f64; 6],
    d: [f64; 6],
    alpha: [f64; 6],
    theta: [f64; 6],
}

const SCHEMA: &str = "graspd-world/1";

fn arm_toml(model: Model, dh: &Dh) -> String {
    let dh = DhRecord { a: dh.a, d: dh.d, alpha: dh.alpha, theta: dh.theta };
    toml::to_string(&ArmFile { model: model.name().to_owned(), dh }).unwrap_or_default()
}

fn pose(r: &PoseRecord) -> Option<Pose> {
    let [w, i, j, k] = r.quaternion_wxyz?;
    let q = Quaternion::new(w, i, j, k);
    let finite = r.translation_m.iter().all(|v| v.is_finite()) && (q.norm() - 1.0).abs() < 1e-6;
    let [x, y, z] = r.translation_m;
    finite.then(|| Pose::from_parts(Translation3::new(x, y, z), UnitQuaternion::new_unchecked(q)))
}

impl Scenario {
    /// Writes the world's files into a folder, which is created if it is missing.
    pub fn save(&self, dir: &Path) -> Result<(), WorldError> {
        std::fs::create_dir_all(dir).map_err(|reason| WorldError::File { path: dir.to_owned(), reason })?;
        let write = |name: &str, text: String| {
            let path = dir.join(name);
            std::fs::write(&path, text).map_err(|reason| WorldError::File { path, reason })
        };
        let mut given = RigFile::new(self.given_rig);
        given.name = Some(format!("simulated rig, seed {}", self.seed));
        given.save(&dir.join("rig.toml"))?;
        RigFile::new(self.true_rig).save(&dir.join("true_rig.toml"))?;
        self.gripper.save(&dir.join("gripper.toml"))?;
        write("arm.toml", arm_toml(self.model, &self.given_dh))?;
        write("true_arm.toml", arm_toml(self.model, &self.true_dh))?;
        let [l, r] = &self.clicks;
        let clicks = serde_json::json!({ "left": [l.x, l.y], "right": [r.x, r.y] });
        write("clicks.json", format!("{clicks}\n"))?;
        let truth = TruthFile {
            schema: SCHEMA.to_owned(),
            seed: self.seed,
            model: self.model.name().to_owned(),
            start_rad: self.start,
            grasp_turn_rad: self.grasp_turn_rad,
            clicks: self.clicks.map(Into::into),
            base_from_left: PoseRecord::of(&self.base_from_left),
            base_from_object: PoseRecord::of(&self.base_from_object),
            sensor: self.sensor,
            stage: self.stage.clone(),
        };
        let text = toml::to_string(&truth)
            .map_err(|e| WorldError::Parse { path: dir.join("truth.toml"), reason: e.to_string() })?;
        write("truth.toml", format!("# Ground truth of the simulators. graspd must never read this file.\n{text}"))
    }

    /// Reads a world.
    pub fn load(dir: &Path) -> Result<Self, WorldError> {
        let read = |name: &str| {
            let path = dir.join(name);
            match std::fs::read_to_string(&path) {
                Ok(text) => Ok((path, text)),
                Err(reason) => Err(WorldError::File { path, reason }),
            }
        };
        let (path, text) = read("truth.toml")?;
        let bad = |path: &Path, reason: String| WorldError::Parse { path: path.to_owned(), reason };
        let t: TruthFile = toml::from_str(&text).map_err(|e| bad(&path, e.to_string()))?;
        if t.schema != SCHEMA {
            return Err(bad(&path, format!("`schema` is {:?}, expected {SCHEMA:?}", t.schema)));
        }
        let model = |path: &Path, name: &str| {
            Model::from_name(name).ok_or_else(|| bad(path, format!("unknown arm `model` {name:?}")))
        };
        let finite = |key: &str, v: &[f64]| {
            v.iter()
                .all(|x| x.is_finite())
                .then_some(())
                .ok_or_else(|| bad(&path, format!("`{key}` holds a value that is NaN or infinite")))
        };
        finite("start_rad", &t.start_rad)?;
        finite("clicks", t.clicks.as_flattened())?;
        let arm = |name: &str| {
            let (path, text) = read(name)?;
            let a: ArmFile = toml::from_str(&text).map_err(|e| bad(&path, e.to_string()))?;
            let dh = Dh { a: a.dh.a, d: a.dh.d, alpha: a.dh.alpha, theta: a.dh.theta };
            if !dh.is_finite() {
                return Err(bad(&path, "`dh` holds a value that is NaN or infinite".to_owned()));
            }
            model(&path, &a.model).map(|_| dh)
        };
        let placed = |key: &str, r: &PoseRecord| {
            pose(r).ok_or_else(|| {
                bad(&path, format!("`{key}` is not a pose: expected finite metres and a unit quaternion"))
            })
        };
        Ok(Self {
            seed: t.seed,
            model: model(&path, &t.model)?,
            true_dh: arm("true_arm.toml")?,
            given_dh: arm("arm.toml")?,
            start: t.start_rad,
            true_rig: RigFile::load(&dir.join("true_rig.toml"))?.rig,
            given_rig: RigFile::load(&dir.join("rig.toml"))?.rig,
            gripper: GripperFile::load(&dir.join("gripper.toml"))?,
            base_from_left: placed("base_from_left", &t.base_from_left)?,
            base_from_object: placed("base_from_object", &t.base_from_object)?,
            grasp_turn_rad: t.grasp_turn_rad,
            stage: t.stage,
            sensor: t.sensor,
            clicks: t.clicks.map(|[u, v]| Pixel::new(u, v)),
        })
    }
}
