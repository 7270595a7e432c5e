//! `gripper.toml`: the marks, the range of the jaws, and the shape of the gripper.

use super::boxes::OrientedBox;
use super::error::{self, FileError, Source};
use super::hash::{ContentHash, Numbers};
use super::pose::PoseRecord;
use graspd_rt::geom::{Pose, Vec3};
use graspd_rt::gripper::{Gripper, MAX_MARKS, Mark};
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use std::path::Path;

const SCHEMA: &str = "graspd-gripper/1";
/// Fewest marks that determine the gripper's pose without ambiguity.
const MIN_MARKS: usize = 4;
/// Smallest distance of at least one mark from the line through the others, metres: nearer marks leave the rotation
/// about that line undetermined.
const MIN_MARK_SPREAD_M: f64 = 2e-3;

/// The content of a gripper file: what the loop needs, and what planning and drawing need in addition.
#[derive(Clone, Debug, PartialEq)]
pub struct GripperFile {
    /// Marks and mounting.
    pub gripper: Gripper,
    /// A name for people.
    pub name: Option<String>,
    /// Smallest and largest distance between the finger pads, metres.
    pub opening: [f64; 2],
    /// Length of the fingers in front of the palm along the approach, metres.
    pub finger_length: f64,
    /// The fingers, which move along x with the opening.
    pub fingers: Vec<Finger>,
    /// The rigid part of the gripper, in the gripper frame.
    pub body: Vec<OrientedBox>,
}

/// A finger: a box that moves along x by half the opening.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Finger {
    /// +1 if the finger opens towards +x, -1 if towards -x.
    pub side: f64,
    /// The finger of the closed jaws, in the gripper frame.
    pub closed: OrientedBox,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Raw {
    schema: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    name: Option<String>,
    opening_m: [f64; 2],
    finger_length_m: f64,
    flange_from_gripper: PoseRecord,
    mark: Vec<RawMark>,
    #[serde(default)]
    finger: Vec<RawFinger>,
    #[serde(default)]
    body: Vec<RawBox>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawMark {
    position_m: [f64; 3],
    normal: [f64; 3],
    diameter_m: f64,
    polarity: Polarity,
}

#[derive(Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Polarity {
    Dark,
    Light,
}

#[derive(Clone, Copy, PartialEq, Serialize, Deserialize)]
enum Side {
    #[serde(rename = "+x")]
    Plus,
    #[serde(rename = "-x")]
    Minus,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawFinger {
    side: Side,
    centre_m: [f64; 3],
    half_size_m: [f64; 3],
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawBox {
    centre_m: [f64; 3],
    half_size_m: [f64; 3],
    #[serde(default, skip_serializing_if = "Option::is_none")]
    rotation_vector_rad: Option<[f64; 3]>,
}

impl GripperFile {
    /// Reads and checks a gripper file.
    ///
    /// # Errors
    /// Names the file, the line, the key and the fix.
    pub fn load(path: &Path) -> Result<Self, FileError> {
        Self::parse(&error::read_text(path)?, &path.display().to_string())
    }

    /// As [`GripperFile::load`], from a text; `name` is the file's name in errors.
    pub fn parse(text: &str, name: &str) -> Result<Self, FileError> {
        let src = Source { name, text };
        let raw: Raw = src.parse()?;
        src.schema(&raw.schema, SCHEMA)?;
        let [lo, hi] = raw.opening_m;
        if !(lo >= 0.0 && hi > lo && hi <= 10.0) {
            return Err(src.refuse(
                "opening_m",
                raw.opening_m,
                "it is not a range of openings",
                "give [smallest, largest] in metres, 0 <= smallest < largest <= 10",
            ));
        }
        let finger_length = src.number("finger_length_m", raw.finger_length_m, 1e-4..=10.0, "metres")?;
        let flange_from_gripper = raw.flange_from_gripper.pose(&src, "flange_from_gripper", 10.0)?;
        let mut gripper = Gripper { marks: Default::default(), flange_from_gripper };
        for (i, m) in raw.mark.iter().enumerate() {
            let mark = mark(&src, i, m)?;
            if gripper.marks.push(mark).is_err() {
                let fix = format!("give at most {MAX_MARKS}");
                return Err(src.refuse("mark", raw.mark.len(), "there are too many marks", fix));
            }
        }
        if gripper.marks.len() < MIN_MARKS {
            return Err(src.refuse(
                "mark",
                gripper.marks.len(),
                "there are too few marks to determine the gripper's pose",
                format!("describe at least {MIN_MARKS}, not all on one line, in [[mark]] tables"),
            ));
        }
        check_layout(&src, &gripper.marks)?;
        let mut fingers = Vec::new();
        for (i, f) in raw.finger.iter().enumerate() {
            let key = format!("finger[{i}]");
            let closed = raw_box(&src, &key, f.centre_m, f.half_size_m, None)?;
            fingers.push(Finger { side: if f.side == Side::Plus { 1.0 } else { -1.0 }, closed });
        }
        let body = raw
            .body
            .iter()
            .enumerate()
            .map(|(i, b)| raw_box(&src, &format!("body[{i}]"), b.centre_m, b.half_size_m, b.rotation_vector_rad))
            .collect::<Result<Vec<_>, _>>()?;
        Ok(Self { gripper, name: raw.name, opening: raw.opening_m, finger_length, fingers, body })
    }

    /// All boxes of the gripper for a jaw opening in metres, fingers first, in the gripper frame.
    pub fn boxes(&self, opening: f64) -> Vec<OrientedBox> {
        let slide = |f: &Finger| f.closed.moved(&Pose::translation(f.side * 0.5 * opening, 0.0, 0.0));
        self.fingers.iter().map(slide).chain(self.body.iter().copied()).collect()
    }

    /// Hash of the values by their bits. Comments and the name do not change it.
    pub fn hash(&self) -> ContentHash {
        let mut h = Numbers::new(SCHEMA);
        h.add(&self.opening);
        h.add(&[self.finger_length]);
        let pose = |h: &mut Numbers, p: &Pose| {
            let r = PoseRecord::of(p);
            h.add(&r.translation_m);
            h.add(&r.quaternion_wxyz.unwrap_or_default());
        };
        pose(&mut h, &self.gripper.flange_from_gripper);
        h.add(&[self.gripper.marks.len() as f64]);
        for m in &self.gripper.marks {
            h.add(m.position.as_slice());
            h.add(m.normal.as_slice());
            h.add(&[m.radius, f64::from(u8::from(m.dark))]);
        }
        h.add(&[self.fingers.len() as f64]);
        for f in &self.fingers {
            h.add(&[f.side]);
            pose(&mut h, &f.closed.frame_from_box);
            h.add(f.closed.half.as_slice());
        }
        for b in &self.body {
            pose(&mut h, &b.frame_from_box);
            h.add(b.half.as_slice());
        }
        h.finish()
    }

    /// The text of the file. Equal grippers give equal bytes.
    pub fn to_toml(&self) -> String {
        let raw = Raw {
            schema: SCHEMA.to_owned(),
            name: self.name.clone(),
            opening_m: self.opening,
            finger_length_m: self.finger_length,
            flange_from_gripper: PoseRecord::of(&self.gripper.flange_from_gripper),
            mark: self
                .gripper
                .marks
                .iter()
                .map(|m| RawMark {
                    position_m: m.position.into(),
                    normal: m.normal.into(),
                    diameter_m: 2.0 * m.radius,
                    polarity: if m.dark { Polarity::Dark } else { Polarity::Light },
                })
                .collect(),
            finger: self
                .fingers
                .iter()
                .map(|f| RawFinger {
                    side: if f.side > 0.0 { Side::Plus } else { Side::Minus },
                    centre_m: f.closed.frame_from_box.translation.vector.into(),
                    half_size_m: f.closed.half.into(),
                })
                .collect(),
            body: self
                .body
                .iter()
                .map(|b| {
                    let r = b.frame_from_box.rotation.scaled_axis();
                    RawBox {
                        centre_m: b.frame_from_box.translation.vector.into(),
                        half_size_m: b.half.into(),
                        rotation_vector_rad: (r.norm() > 0.0).then_some(r.into()),
                    }
                })
                .collect(),
        };
        let body = toml::to_string(&raw).unwrap_or_default();
        format!(
            "# A gripper: origin between the finger tips, z along the approach, x along the closing direction. Metres.\n\
             # Every key is described in docs/FILES.md.\n{body}"
        )
    }

    /// Writes the file.
    pub fn save(&self, path: &Path) -> Result<(), FileError> {
        error::write_text(path, &self.to_toml())
    }
}

fn mark(src: &Source<'_>, i: usize, m: &RawMark) -> Result<Mark, FileError> {
    let k = |leaf: &str| format!("mark[{i}].{leaf}");
    let position = src.vector(&k("position_m"), m.position_m, 10.0, "metres")?;
    let n = src.vector(&k("normal"), m.normal, 1e3, "numbers")?;
    let len = n.norm();
    if len < 1e-3 {
        let fix = "give the outward normal of the mark's face";
        return Err(src.refuse(&k("normal"), m.normal, "its length is nearly 0", fix));
    }
    // No normalisation if it is not needed: a written file is read back bit for bit.
    let normal = if (len - 1.0).abs() < 1e-14 { n } else { n / len };
    let d = src.number(&k("diameter_m"), m.diameter_m, 1e-4..=1.0, "the diameter in metres")?;
    Ok(Mark { position, normal, radius: 0.5 * d, dark: m.polarity == Polarity::Dark })
}

/// Refuses marks that overlap or are all on one line: they do not determine a pose.
fn check_layout(src: &Source<'_>, marks: &[Mark]) -> Result<(), FileError> {
    for (i, a) in marks.iter().enumerate() {
        for (j, b) in marks.iter().enumerate().skip(i + 1) {
            if (a.position - b.position).norm() < a.radius + b.radius {
                return Err(src.refuse(
                    &format!("mark[{j}].position_m"),
                    b.position.as_slice(),
                    format!("it overlaps mark[{i}]"),
                    "move one of them, or correct the diameters",
                ));
            }
        }
    }
    let n = marks.len() as f64;
    let mean: Vec3 = marks.iter().map(|m| m.position).sum::<Vec3>() / n;
    let first =
        marks.iter().map(|m| m.position - mean).max_by(|a, b| a.norm().total_cmp(&b.norm())).unwrap_or_default();
    let spread =
        marks.iter().map(|m| (m.position - mean).cross(&first).norm() / first.norm().max(1e-12)).fold(0.0, f64::max);
    if !(spread > MIN_MARK_SPREAD_M) {
        return Err(src.refuse(
            "mark",
            format!("{} marks within {:.1} mm of one line", marks.len(), spread * 1e3),
            "the rotation about that line cannot be observed",
            "move at least one mark away from the line",
        ));
    }
    Ok(())
}

fn raw_box(
    src: &Source<'_>,
    key: &str,
    c: [f64; 3],
    half: [f64; 3],
    rot: Option<[f64; 3]>,
) -> Result<OrientedBox, FileError> {
    let centre = src.vector(&format!("{key}.centre_m"), c, 10.0, "metres")?;
    let half_v = src.vector(&format!("{key}.half_size_m"), half, 10.0, "metres")?;
    if half.iter().any(|h| *h <= 0.0) {
        return Err(src.refuse(
            &format!("{key}.half_size_m"),
            half,
            "the half sizes are not all positive",
            "give half of the length of each edge in metres",
        ));
    }
    let rotation = match rot {
        Some(r) => {
            UnitQuaternion::from_scaled_axis(src.vector(&format!("{key}.rotation_vector_rad"), r, 6.3, "radians")?)
        }
        None => UnitQuaternion::identity(),
    };
    Ok(OrientedBox {
        frame_from_box: Pose::from_parts(Translation3::from(centre), rotation),
        half: Vector3::from(half_v),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = r#"
schema = "graspd-gripper/1"
opening_m = [0.0, 0.18]
finger_length_m = 0.06
flange_from_gripper = { translation_m = [0.0, 0.0, 0.2], quaternion_wxyz = [1.0, 0.0, 0.0, 0.0] }

[[mark]]
position_m = [-0.04, -0.02, -0.13]
normal = [0.0, 0.5736, -0.8192]
diameter_m = 0.012
polarity = "dark"

[[mark]]
position_m = [0.04, -0.02, -0.13]
normal = [0.0, 0.5736, -0.8192]
diameter_m = 0.012
polarity = "dark"

[[mark]]
position_m = [0.04, 0.02, -0.11]
normal = [0.0, 0.5736, -0.8192]
diameter_m = 0.012
polarity = "light"

[[mark]]
position_m = [-0.03, 0.02, -0.11]
normal = [0.0, 0.5736, -0.8192]
diameter_m = 0.012
polarity = "dark"

[[finger]]
side = "+x"
centre_m = [0.01, 0.0, -0.03]
half_size_m = [0.01, 0.012, 0.03]

[[body]]
centre_m = [0.0, 0.0, -0.09]
half_size_m = [0.1, 0.03, 0.02]
rotation_vector_rad = [0.1, 0.0, 0.0]
"#;

    #[test]
    fn a_written_file_is_read_back_unchanged() {
        let a = GripperFile::parse(TEXT, "g").unwrap();
        let b = GripperFile::parse(&a.to_toml(), "g").unwrap();
        assert_eq!(a.gripper.marks, b.gripper.marks);
        assert_eq!(b.to_toml(), GripperFile::parse(&b.to_toml(), "g").unwrap().to_toml());
        assert!((a.boxes(0.1)[0].frame_from_box.translation.x - 0.06).abs() < 1e-15);
        assert!((a.gripper.marks[0].normal.norm() - 1.0).abs() < 1e-14);
    }

    #[test]
    fn errors_name_the_mark() {
        let show =
            |from: &str, to: &str| GripperFile::parse(&TEXT.replacen(from, to, 1), "g.toml").unwrap_err().to_string();
        let e = show("position_m = [0.04, 0.02, -0.11]", "position_m = [0.041, -0.02, -0.13]");
        assert!(e.contains("g.toml:20: `mark[2].position_m`") && e.contains("overlaps mark[1]"), "{e}");
        let e = show("diameter_m = 0.012", "diameter_m = 12.0");
        assert!(e.contains("mark[0].diameter_m") && e.contains("metres"), "{e}");
        let e = show("polarity = \"dark\"", "polarity = \"black\"");
        assert!(e.contains("black") && e.contains("dark"), "{e}");
        let e = show("opening_m = [0.0, 0.18]", "opening_m = [0.2, 0.18]");
        assert!(e.contains("opening_m"), "{e}");
        let e = show("half_size_m = [0.01,", "half_size_m = [-0.01,");
        assert!(e.contains("finger[0].half_size_m"), "{e}");
        let line = TEXT
            .replace("0.02, -0.11]", "-0.02, -0.13]")
            .replace("position_m = [0.04, -0.02", "position_m = [0.07, -0.02");
        let line = line.replacen("position_m = [0.07", "position_m = [0.04", 1);
        let e = GripperFile::parse(&line, "g.toml").unwrap_err().to_string();
        assert!(e.contains("one line") || e.contains("overlaps"), "{e}");
    }
}
