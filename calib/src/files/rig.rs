//! `rig.toml`: both cameras and their relative pose.

use super::error::{self, FileError, Source};
use super::hash::{ContentHash, Numbers};
use super::pose::PoseRecord;
use super::rig_covariance::RigCovariance;
use graspd_rt::geom::{Camera, CameraError, Distortion, Rig, RigError};
use serde::{Deserialize, Serialize};
use std::path::Path;

const SCHEMA: &str = "graspd-rig/1";

/// The content of a rig file: the calibrated rig, and data about its calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct RigFile {
    /// The rig.
    pub rig: Rig,
    /// A name for people.
    pub name: Option<String>,
    /// Date of the calibration, as text.
    pub date: Option<String>,
    /// Quality of the calibration.
    pub quality: Option<Quality>,
    /// Covariance of its parameters, where a calibration left it.
    pub covariance: Option<RigCovariance>,
}

/// Quality of a calibration. The standard deviations are those of the rig's error.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Quality {
    /// Root mean square reprojection error in the images used, pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rms_px: Option<f64>,
    /// Root mean square reprojection error in hold-out images, pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub holdout_rms_px: Option<f64>,
    /// Number of image pairs used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub images: Option<u32>,
    /// Standard deviation of the relative rotation about each axis, radians.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rotation_rad: Option<f64>,
    /// Relative standard deviation of the focal length common to both cameras.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub focal: Option<f64>,
    /// Relative standard deviation of half the difference of the focal lengths.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub focal_difference: Option<f64>,
    /// Standard deviation of each coordinate of the principal points, pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub principal_px: Option<f64>,
    /// Free text.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Raw {
    schema: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    name: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    date: Option<String>,
    left: RawCamera,
    right: RawCamera,
    right_from_left: PoseRecord,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    quality: Option<Quality>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    covariance: Option<RigCovariance>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawCamera {
    width: u32,
    height: u32,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    #[serde(default, skip_serializing_if = "RawDistortion::is_none")]
    distortion: RawDistortion,
}

#[derive(Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct RawDistortion {
    k1: f64,
    k2: f64,
    p1: f64,
    p2: f64,
    k3: f64,
    k4: f64,
    k5: f64,
    k6: f64,
}

impl RawDistortion {
    fn is_none(&self) -> bool {
        *self == Self::default()
    }
}

impl RigFile {
    /// Reads and checks a rig file.
    ///
    /// # Errors
    /// Names the file, the line, the key and the fix.
    pub fn load(path: &Path) -> Result<Self, FileError> {
        Self::parse(&error::read_text(path)?, &path.display().to_string())
    }

    /// As [`RigFile::load`], from a text; `name` is the file's name in errors.
    pub fn parse(text: &str, name: &str) -> Result<Self, FileError> {
        let src = Source { name, text };
        let raw: Raw = src.parse()?;
        src.schema(&raw.schema, SCHEMA)?;
        let left = camera(&src, "left", &raw.left)?;
        let right = camera(&src, "right", &raw.right)?;
        let right_from_left = raw.right_from_left.pose(&src, "right_from_left", 1e3)?;
        let baseline = right_from_left.translation.vector.norm();
        if baseline < 1e-4 {
            return Err(src.refuse(
                "right_from_left.translation_m",
                raw.right_from_left.translation_m,
                "the two cameras are at one position, so depth cannot be measured",
                "give the translation in metres from a stereo calibration",
            ));
        }
        if let Some(q) = &raw.quality {
            stated_error(&src, q)?;
        }
        if let Some(c) = &raw.covariance {
            c.check(&src)?;
        }
        let rig = Rig { left, right, right_from_left };
        Ok(Self { rig, name: raw.name, date: raw.date, quality: raw.quality, covariance: raw.covariance })
    }

    /// A rig without data about its calibration.
    pub fn new(rig: Rig) -> Self {
        Self { rig, name: None, date: None, quality: None, covariance: None }
    }

    /// The rig's error as stated in the file; the default for every value that is not stated.
    pub fn error(&self) -> RigError {
        let d = RigError::default();
        self.quality.as_ref().map_or(d, |q| RigError {
            rotation_rad: q.rotation_rad.unwrap_or(d.rotation_rad),
            focal: q.focal.unwrap_or(d.focal),
            focal_difference: q.focal_difference.unwrap_or(d.focal_difference),
            principal_px: q.principal_px.unwrap_or(d.principal_px),
        })
    }

    /// Hash of the cameras and their relative pose by their bits. Comments, name, date and quality do not change it.
    pub fn hash(&self) -> ContentHash {
        let mut h = Numbers::new(SCHEMA);
        for c in [&self.rig.left, &self.rig.right] {
            let d = &c.distortion;
            h.add(&[f64::from(c.width), f64::from(c.height), c.fx, c.fy, c.cx, c.cy]);
            h.add(&[d.k1, d.k2, d.p1, d.p2, d.k3, d.k4, d.k5, d.k6]);
        }
        let p = PoseRecord::of(&self.rig.right_from_left);
        h.add(&p.translation_m);
        h.add(&p.quaternion_wxyz.unwrap_or_default());
        h.finish()
    }

    /// The short identity of the calibration: the first eight bytes of [`RigFile::hash`].
    pub fn id(&self) -> u64 {
        self.hash().short()
    }

    /// The text of the file. Equal rigs give equal bytes.
    pub fn to_toml(&self) -> String {
        let raw = Raw {
            schema: SCHEMA.to_owned(),
            name: self.name.clone(),
            date: self.date.clone(),
            left: raw_camera(&self.rig.left),
            right: raw_camera(&self.rig.right),
            right_from_left: PoseRecord::of(&self.rig.right_from_left),
            quality: self.quality.clone(),
            covariance: self.covariance.clone(),
        };
        let body = toml::to_string(&raw).unwrap_or_default();
        format!(
            "# A calibrated stereo rig. Lengths in metres, images in pixels; every key is described in docs/FILES.md.\n{body}"
        )
    }

    /// Writes the file.
    pub fn save(&self, path: &Path) -> Result<(), FileError> {
        error::write_text(path, &self.to_toml())
    }
}

/// Checks the stated error of the rig. Zero would leave the gates without any allowance for the rig's error; a rig
/// whose error exceeds the upper limits is not calibrated.
fn stated_error(src: &Source<'_>, q: &Quality) -> Result<(), FileError> {
    let values = [
        (
            "rotation_rad",
            q.rotation_rad,
            1e-6..=0.02,
            "one standard deviation of the relative rotation, rad (0.001 is 0.06 degrees)",
        ),
        ("focal", q.focal, 1e-6..=0.05, "one standard deviation of the focal lengths, relative (0.005 is 0.5 %)"),
        (
            "focal_difference",
            q.focal_difference,
            1e-6..=0.05,
            "one standard deviation of half the focal lengths' difference, relative",
        ),
        ("principal_px", q.principal_px, 1e-3..=50.0, "one standard deviation of the principal points, pixels"),
    ];
    for (leaf, value, range, what) in values {
        if let Some(v) = value {
            src.number(&format!("quality.{leaf}"), v, range, what)?;
        }
    }
    Ok(())
}

fn raw_camera(c: &Camera) -> RawCamera {
    let d = &c.distortion;
    RawCamera {
        width: c.width,
        height: c.height,
        fx: c.fx,
        fy: c.fy,
        cx: c.cx,
        cy: c.cy,
        distortion: RawDistortion { k1: d.k1, k2: d.k2, p1: d.p1, p2: d.p2, k3: d.k3, k4: d.k4, k5: d.k5, k6: d.k6 },
    }
}

fn camera(src: &Source<'_>, key: &str, r: &RawCamera) -> Result<Camera, FileError> {
    let d = &r.distortion;
    let c = Camera {
        width: r.width,
        height: r.height,
        fx: r.fx,
        fy: r.fy,
        cx: r.cx,
        cy: r.cy,
        distortion: Distortion { k1: d.k1, k2: d.k2, p1: d.p1, p2: d.p2, k3: d.k3, k4: d.k4, k5: d.k5, k6: d.k6 },
    };
    let k = |leaf: &str| format!("{key}.{leaf}");
    if r.width == 0 || r.width > 65_535 {
        return Err(src.refuse(&k("width"), r.width, "it is not an image width", "give pixels, 1 to 65535"));
    }
    if r.height == 0 || r.height > 65_535 {
        return Err(src.refuse(&k("height"), r.height, "it is not an image height", "give pixels, 1 to 65535"));
    }
    for (leaf, v) in [("fx", r.fx), ("fy", r.fy)] {
        src.number(&k(leaf), v, 1.0..=1e6, "the focal length in pixels")?;
    }
    for (leaf, v) in [("cx", r.cx), ("cy", r.cy)] {
        src.number(&k(leaf), v, -1e6..=1e6, "the principal point in pixels")?;
    }
    for (leaf, v) in
        [("k1", d.k1), ("k2", d.k2), ("p1", d.p1), ("p2", d.p2), ("k3", d.k3), ("k4", d.k4), ("k5", d.k5), ("k6", d.k6)]
    {
        src.number(&k(&format!("distortion.{leaf}")), v, -1e6..=1e6, "a coefficient in OpenCV's order")?;
    }
    c.validated().map_err(|e| match e {
        CameraError::Folds => src.refuse(
            &k("distortion"),
            [d.k1, d.k2, d.p1, d.p2, d.k3],
            "the lens model folds the image over itself, so that a pixel has no unique ray",
            "check the order k1, k2, p1, p2, k3 and the signs, or calibrate with points up to the image corners",
        ),
        CameraError::NotFinite => {
            src.refuse(key, "NaN or infinity", "a parameter is not finite", "calibrate the camera again")
        }
        CameraError::FocalLength => src.refuse(&k("fx"), [r.fx, r.fy], "it is not a focal length", "give pixels"),
        CameraError::ImageSize => {
            src.refuse(&k("width"), [r.width, r.height], "it is not an image size", "give pixels")
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(crate) const TEXT: &str = r#"
schema = "graspd-rig/1"
name = "bench"

[left]
width = 1280
height = 1024
fx = 1200.0
fy = 1199.5
cx = 640.0
cy = 512.0
distortion = { k1 = -0.2, k2 = 0.05 }

[right]
width = 1280
height = 1024
fx = 1200.0
fy = 1200.0
cx = 640.0
cy = 512.0

[right_from_left]
translation_m = [-0.5, 0.0, 0.02]
rotation_vector_rad = [0.0, 0.3, 0.0]
"#;

    #[test]
    fn a_written_file_is_read_back_bit_for_bit() {
        let a = RigFile::parse(TEXT, "rig.toml").unwrap();
        let text = a.to_toml();
        let b = RigFile::parse(&text, "rig.toml").unwrap();
        assert_eq!(a.hash(), b.hash());
        assert_eq!(b.to_toml(), text);
        assert_eq!(b.rig.left.distortion.k1, -0.2);
    }

    #[test]
    fn the_identity_depends_on_the_calibration_only() {
        let a = RigFile::parse(TEXT, "rig.toml").unwrap();
        let b = RigFile::parse(&TEXT.replace("bench", "other"), "rig.toml").unwrap();
        let c = RigFile::parse(&TEXT.replace("1199.5", "1199.6"), "rig.toml").unwrap();
        assert_eq!(a.id(), b.id());
        assert_ne!(a.id(), c.id());
    }

    #[test]
    fn the_stated_error_is_read_and_defaults_fill_the_rest() {
        let a = RigFile::parse(TEXT, "rig.toml").unwrap();
        assert_eq!(a.error(), RigError::default());
        let text = format!("{TEXT}\n[quality]\nrotation_rad = 2e-4\nprincipal_px = 0.3\n");
        let b = RigFile::parse(&text, "rig.toml").unwrap();
        assert_eq!(b.error(), RigError { rotation_rad: 2e-4, principal_px: 0.3, ..RigError::default() });
        // The quality does not change the identity, and it survives writing.
        assert_eq!(a.id(), b.id());
        assert_eq!(RigFile::parse(&b.to_toml(), "rig.toml").unwrap().error(), b.error());
        for bad in ["rotation_rad = 0.1", "focal = 0.0", "principal_px = nan", "focal_difference = -0.001"] {
            let e = RigFile::parse(&format!("{TEXT}\n[quality]\n{bad}\n"), "rig.toml").unwrap_err().to_string();
            let key = bad.split(' ').next().unwrap();
            assert!(e.contains(&format!("quality.{key}")) && e.contains("standard deviation"), "{e}");
        }
    }

    #[test]
    fn errors_name_file_line_key_and_fix() {
        let show = |from: &str, to: &str| RigFile::parse(&TEXT.replace(from, to), "rig.toml").unwrap_err().to_string();
        let e = show("fy = 1199.5", "fy = -3.0");
        assert!(e.starts_with("rig.toml:9: `left.fy` = -3.0") && e.contains("focal length in pixels between"), "{e}");
        let e = show("cx = 640.0\ncy = 512.0\n\n", "cx = nan\ncy = 512.0\n\n");
        assert!(e.contains("right.cx") && e.contains(":19:"), "{e}");
        let e = show("k2 = 0.05", "k9 = 0.05");
        assert!(e.contains("rig.toml:12:") && e.contains("unknown field `k9`") && e.contains("k1"), "{e}");
        let e = show("k1 = -0.2", "k1 = -5.0");
        assert!(e.contains("left.distortion") && e.contains("folds"), "{e}");
        let e = show("[-0.5, 0.0, 0.02]", "[0.0, 0.0, 0.0]");
        assert!(e.contains("right_from_left.translation_m") && e.contains("one position"), "{e}");
        let e = show("graspd-rig/1", "graspd-gripper/1");
        assert!(e.contains("schema") && e.contains("another kind of file"), "{e}");
        let e = show("height = 1024\nfx = 1200.0\nfy = 1199.5", "fx = 1200.0\nfy = 1199.5");
        assert!(e.contains("missing field `height`"), "{e}");
        let e = show("[left]", "[left");
        assert!(e.starts_with("rig.toml:5:"), "{e}");
        let e = RigFile::load(Path::new("no/such/rig.toml")).unwrap_err().to_string();
        assert!(e.starts_with("no/such/rig.toml: cannot be read"), "{e}");
    }
}
