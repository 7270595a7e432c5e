//! The pose of a part with a mesh: `pose.toml`, or points of it picked in both images, `picks.toml`.

use super::error::{self, FileError, Source};
use super::pose::PoseRecord;
use graspd_rt::geom::{Pixel, Pose, Vec3};
use serde::Deserialize;
use std::path::Path;

/// A pose in the left camera's frame, with its uncertainty.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseFile {
    /// The pose: `left_from_mesh` of a part, `left_from_gripper` of the gripper at present, or `left_from_base` of an
    /// arm.
    pub pose: Pose,
    /// Standard deviation of each coordinate, metres, if stated.
    pub sigma_m: Option<f64>,
    /// Standard deviation of the rotation about each axis, radians, if stated.
    pub sigma_rad: Option<f64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawPose {
    schema: String,
    left_from_mesh: Option<PoseRecord>,
    left_from_gripper: Option<PoseRecord>,
    left_from_base: Option<PoseRecord>,
    sigma_mm: Option<f64>,
    sigma_deg: Option<f64>,
}

impl PoseFile {
    /// Reads the pose called `key` from a pose file.
    ///
    /// # Errors
    /// Names the file, the line, the key and the fix.
    pub fn load(path: &Path, key: &'static str) -> Result<Self, FileError> {
        Self::parse(&error::read_text(path)?, &path.display().to_string(), key)
    }

    /// As [`PoseFile::load`], from a text; `name` is the file's name in errors.
    pub fn parse(text: &str, name: &str, key: &'static str) -> Result<Self, FileError> {
        let src = Source { name, text };
        let raw: RawPose = src.parse()?;
        src.schema(&raw.schema, "graspd-pose/1")?;
        let record = match key {
            "left_from_mesh" => raw.left_from_mesh,
            "left_from_gripper" => raw.left_from_gripper,
            _ => raw.left_from_base,
        };
        let record = record.ok_or_else(|| {
            src.refuse(
                key,
                "nothing",
                "the pose is missing",
                format!("add `{key} = {{ translation_m = [...], quaternion_wxyz = [...] }}`"),
            )
        })?;
        let pose = record.pose(&src, key, 100.0)?;
        let sigma = |key: &str, v: Option<f64>, max: f64, unit: &str| {
            v.map(|v| src.number(key, v, 0.0..=max, unit)).transpose()
        };
        Ok(Self {
            pose,
            sigma_m: sigma("sigma_mm", raw.sigma_mm, 1e3, "millimetres")?.map(|v| v * 1e-3),
            sigma_rad: sigma("sigma_deg", raw.sigma_deg, 180.0, "degrees")?.map(f64::to_radians),
        })
    }
}

/// A point of a mesh and its pixels in both images.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pick {
    /// The point in the mesh frame, in the unit of the mesh file.
    pub point: Vec3,
    /// Its pixel in the left image.
    pub left: Pixel,
    /// Its pixel in the right image.
    pub right: Pixel,
}

impl Pick {
    /// Parses "X,Y,Z=UL,VL,UR,VR"; `None` if the text is anything else.
    pub fn parse(text: &str) -> Option<Self> {
        let (point, pixels) = text.split_once('=')?;
        let numbers = |t: &str| -> Option<Vec<f64>> {
            t.split(',').map(|n| n.trim().parse::<f64>().ok().filter(|v| v.is_finite())).collect()
        };
        match (numbers(point)?.as_slice(), numbers(pixels)?.as_slice()) {
            ([x, y, z], [a, b, c, d]) => {
                Some(Self { point: Vec3::new(*x, *y, *z), left: Pixel::new(*a, *b), right: Pixel::new(*c, *d) })
            }
            _ => None,
        }
    }
}

/// Points picked in both images.
#[derive(Clone, Debug, PartialEq)]
pub struct PicksFile {
    /// The picks, in the order of the file.
    pub picks: Vec<Pick>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawPicks {
    schema: String,
    #[serde(default)]
    pick: Vec<RawPick>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawPick {
    point: [f64; 3],
    left_px: [f64; 2],
    right_px: [f64; 2],
}

impl PicksFile {
    /// Reads a file of picks.
    ///
    /// # Errors
    /// Names the file, the line, the key and the fix.
    pub fn load(path: &Path) -> Result<Self, FileError> {
        Self::parse(&error::read_text(path)?, &path.display().to_string())
    }

    /// As [`PicksFile::load`], from a text; `name` is the file's name in errors.
    pub fn parse(text: &str, name: &str) -> Result<Self, FileError> {
        let src = Source { name, text };
        let raw: RawPicks = src.parse()?;
        src.schema(&raw.schema, "graspd-picks/1")?;
        let mut picks = Vec::with_capacity(raw.pick.len());
        for (k, p) in raw.pick.iter().enumerate() {
            let point = src.vector(&format!("pick[{k}].point"), p.point, 1e5, "coordinates in the mesh's unit")?;
            for (key, px) in [("left_px", p.left_px), ("right_px", p.right_px)] {
                if px.iter().any(|v| !(v.abs() < 1e5)) {
                    return Err(src.refuse(
                        &format!("pick[{k}].{key}"),
                        px,
                        "it is not a pixel",
                        "give two numbers within plus or minus 100000",
                    ));
                }
            }
            picks.push(Pick { point, left: Pixel::from(p.left_px), right: Pixel::from(p.right_px) });
        }
        Ok(Self { picks })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_and_picks_are_parsed_and_errors_name_the_key() {
        let pose = "schema = \"graspd-pose/1\"\nsigma_mm = 0.5\n[left_from_mesh]\ntranslation_m = [0.0, 0.1, 1.5]\nrotation_vector_rad = [0.0, 0.0, 1.0]\n";
        let p = PoseFile::parse(pose, "p.toml", "left_from_mesh").unwrap();
        assert_eq!((p.pose.translation.y, p.sigma_m, p.sigma_rad), (0.1, Some(0.5e-3), None));
        assert!(PoseFile::parse(pose, "p.toml", "left_from_base").unwrap_err().to_string().contains("left_from_base"));
        let picks = "schema = \"graspd-picks/1\"\n[[pick]]\npoint = [1, 2, 3.5]\nleft_px = [4, 5]\nright_px = [6, 7]\n";
        assert_eq!(PicksFile::parse(picks, "q").unwrap().picks, [Pick::parse("1,2,3.5=4,5,6,7").unwrap()]);
        let bad = PicksFile::parse(&picks.replace("[4, 5]", "[nan, 5]"), "q.toml").unwrap_err().to_string();
        assert!(bad.contains("q.toml:4") && bad.contains("pick[0].left_px"), "{bad}");
        for bad in ["1,2,3", "1,2=3,4,5,6", "1,2,3=4,5,6", "1,2,nan=4,5,6,7", "=", "1,2,3=4,5,6,7,8"] {
            assert_eq!(Pick::parse(bad), None, "{bad}");
        }
    }
}
