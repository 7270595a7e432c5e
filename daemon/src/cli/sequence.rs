//! A recorded stereo sequence with ground truth: cameras, marks, poses and images in plain files.
//!
//! | file | columns |
//! |---|---|
//! | `scene.json` | `conds`: comma-separated names of the conditions |
//! | `cameras.csv` | cam, width, height, fu, fv, u0, v0, camera from rig as r11..r33, tx, ty, tz; no distortion |
//! | `marks.csv` | mark, centre x, y, z and unit normal in the gripper frame, radius (m) |
//! | `poses.csv`, `goal_pose.csv` | frame, rig from gripper as r11..r33, tx, ty, tz |
//! | `truth.csv` | frame, cam, mark, image of the disc's centre (u, v), then columns that are ignored |
//! | `CONDITION/camC/FFFFFF.pgm` | 8-bit images |

use crate::exit::Failure;
use graspd_rt::geom::{Camera, Distortion, Pixel, Pose, Rig, Vec3};
use graspd_rt::gripper::{Gripper, Mark};
use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion};
use std::path::{Path, PathBuf};

/// One grey image.
pub(super) struct Image {
    /// Width in pixels.
    pub(super) width: usize,
    /// Height in pixels.
    pub(super) height: usize,
    /// Grey values, row by row without padding.
    pub(super) grey: Vec<u8>,
}

/// One stereo pair.
pub(super) struct Frame {
    /// Left and right.
    pub(super) images: [Image; 2],
}

/// A sequence without its images.
pub(super) struct Sequence {
    root: PathBuf,
    /// Names of the conditions: folders with the same motion under different lighting.
    pub(super) conditions: Vec<String>,
    /// The cameras; the frame of the left one is the reference.
    pub(super) rig: Rig,
    /// The marks.
    pub(super) gripper: Gripper,
    /// True pose of each frame.
    pub(super) left_from_gripper: Vec<Pose>,
    /// Goal pose of the control law.
    pub(super) goal: Pose,
    /// True projections of the disc centres, by frame, view and mark.
    pub(super) centres: Vec<[Vec<Pixel>; 2]>,
}

impl Sequence {
    /// Reads everything but the images.
    ///
    /// # Errors
    /// A file that cannot be read or is invalid; the message gives the file and, for a bad row, the line.
    pub(super) fn read(root: &Path) -> Result<Self, Failure> {
        let scene = root.join("scene.json");
        let text = std::fs::read_to_string(&scene).map_err(|e| unreadable(&scene, &e.to_string()))?;
        let scene_json: serde_json::Value =
            serde_json::from_str(&text).map_err(|e| unreadable(&scene, &e.to_string()))?;
        let names =
            scene_json["conds"].as_str().ok_or_else(|| unreadable(&scene, "the key conds has no string value"))?;
        let cameras = table(&root.join("cameras.csv"), 19, 2)?;
        let [left, right] = [camera(&cameras[0]), camera(&cameras[1])];
        let [left_from_rig, right_from_rig] = [pose(&cameras[0][7..]), pose(&cameras[1][7..])];
        let rig = Rig { left, right, right_from_left: right_from_rig * left_from_rig.inverse() };
        let file = root.join("marks.csv");
        let mut gripper = Gripper { marks: Default::default(), flange_from_gripper: Pose::identity() };
        for m in table(&file, 8, 3)? {
            let mark = Mark {
                position: Vec3::new(m[1], m[2], m[3]),
                normal: Vec3::new(m[4], m[5], m[6]),
                radius: m[7],
                dark: false,
            };
            gripper.marks.push(mark).map_err(|_| unreadable(&file, "more than 32 marks"))?;
        }
        let poses = table(&root.join("poses.csv"), 13, 1)?;
        let left_from_gripper: Vec<Pose> = poses.iter().map(|p| left_from_rig * pose(&p[1..])).collect();
        let goal = left_from_rig * pose(&table(&root.join("goal_pose.csv"), 13, 1)?[0][1..]);
        let centres = centres(&root.join("truth.csv"), left_from_gripper.len(), gripper.marks.len())?;
        let conditions = names.split(',').map(str::to_owned).collect();
        Ok(Self { root: root.to_owned(), conditions, rig, gripper, left_from_gripper, goal, centres })
    }

    /// Reads the images of one condition.
    ///
    /// # Errors
    /// An image that cannot be read, or whose size differs from that of its camera.
    pub(super) fn frames(&self, condition: &str) -> Result<Vec<Frame>, Failure> {
        let one = |k: usize, index: usize, camera: &Camera| -> Result<Image, Failure> {
            let file = self.root.join(condition).join(format!("cam{index}")).join(format!("{k:06}.pgm"));
            let image = image::open(&file).map_err(|e| unreadable(&file, &e.to_string()))?.into_luma8();
            let (w, h) = image.dimensions();
            if (w, h) != (camera.width, camera.height) {
                let why = format!("image size mismatch: got {w}x{h}, expected {}x{}", camera.width, camera.height);
                return Err(unreadable(&file, &why));
            }
            Ok(Image { width: w as usize, height: h as usize, grey: image.into_raw() })
        };
        (0..self.left_from_gripper.len())
            .map(|k| Ok(Frame { images: [one(k, 0, &self.rig.left)?, one(k, 1, &self.rig.right)?] }))
            .collect()
    }
}

fn unreadable(file: &Path, why: &str) -> Failure {
    Failure::input(format!("{}: {why}; give the directory of a recorded sequence", file.display()))
}

/// Numbers of a CSV file with a header line: at least `rows` rows of at least `columns` finite numbers.
fn table(file: &Path, columns: usize, rows: usize) -> Result<Vec<Vec<f64>>, Failure> {
    let text = std::fs::read_to_string(file).map_err(|e| unreadable(file, &e.to_string()))?;
    let mut all = Vec::new();
    for (k, line) in text.lines().enumerate().skip(1).filter(|(_, l)| !l.trim().is_empty()) {
        let row: Result<Vec<f64>, _> = line.split(',').map(|v| v.trim().parse::<f64>()).collect();
        let row = row.map_err(|e| unreadable(file, &format!("line {}: {e}", k + 1)))?;
        if row.len() < columns || row.iter().any(|v| !v.is_finite()) {
            return Err(unreadable(file, &format!("line {}: expected at least {columns} finite numbers", k + 1)));
        }
        all.push(row);
    }
    if all.len() < rows {
        return Err(unreadable(file, &format!("{} rows, expected at least {rows}", all.len())));
    }
    Ok(all)
}

fn camera(row: &[f64]) -> Camera {
    Camera {
        width: row[1] as u32,
        height: row[2] as u32,
        fx: row[3],
        fy: row[4],
        cx: row[5],
        cy: row[6],
        distortion: Distortion::default(),
    }
}

/// A pose from the nine entries of a rotation matrix in row-major order and a translation.
fn pose(v: &[f64]) -> Pose {
    let r = Matrix3::from_row_slice(&v[..9]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(r));
    Pose::from_parts(Translation3::new(v[9], v[10], v[11]), rotation)
}

fn centres(file: &Path, frames: usize, marks: usize) -> Result<Vec<[Vec<Pixel>; 2]>, Failure> {
    let mut all = vec![[vec![Pixel::zeros(); marks], vec![Pixel::zeros(); marks]]; frames];
    let rows = table(file, 5, 2 * frames * marks)?;
    for (k, row) in rows.iter().enumerate() {
        let slot = all
            .get_mut(row[0] as usize)
            .and_then(|f| f.get_mut(row[1] as usize))
            .and_then(|v| v.get_mut(row[2] as usize));
        let slot = slot.ok_or_else(|| unreadable(file, &format!("line {}: no such frame, camera or mark", k + 2)))?;
        *slot = Pixel::new(row[3], row[4]);
    }
    Ok(all)
}
