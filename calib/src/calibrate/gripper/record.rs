//! Records marks and joints at every rest of the arm. It does not command any motion.

use super::report::{camera, matrix};
use graspd_rt::arm::{Dh, Joints};
use graspd_rt::geom::{Pixel, Pose, Rig, Vec3};
use serde_json::{Value, json};

/// Maximum speed of a joint at rest, rad/s: a controller reports ten times less for a joint that holds its position.
const MAX_REST_SPEED_RAD_S: f64 = 2e-3;
/// Maximum joint travel within one rest, rad: 0.01 degrees, half of an arm's repeatability.
const MAX_REST_TRAVEL_RAD: f64 = 1.7e-4;
/// Time from the end of a motion until vibrations have decayed and the delay from exposure to telemetry has passed,
/// seconds.
const SETTLE_S: f64 = 0.5;
/// Averaging time of a rest, seconds.
const AVERAGE_S: f64 = 1.0;
/// Minimum number of samples of a rest: about half of what 50 telemetry samples per second provide.
const MIN_SAMPLES: usize = 20;
/// Minimum distance of the flange from every stored rest, in position (m) or in orientation (rad).
const MIN_SEPARATION: [f64; 2] = [5e-3, 0.03];
/// Minimum fraction of the samples in which a mark has to be detected.
const MIN_SEEN_FRACTION: f64 = 0.5;
/// Minimum number of marks in each image.
const MIN_MARKS: usize = 3;

/// One telemetry sample.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample {
    /// Time stamp, seconds.
    pub time_s: f64,
    /// Joint positions, rad.
    pub q: Joints,
    /// Joint velocities, rad/s.
    pub qd: Joints,
    /// Marks by view and index; `None` if not detected.
    pub marks: [Vec<Option<Pixel>>; 2],
}

/// Result of a sample.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// No event.
    None,
    /// A rest was stored: its number, from 1, and its number of marks in the left and in the right image.
    Stored(usize, [usize; 2]),
    /// A rest was not stored, with the reason.
    Skipped(String),
}

/// A stored rest.
#[derive(Clone, Debug, PartialEq)]
struct Rest {
    q: Joints,
    base_from_flange: Pose,
    marks: [Vec<Option<Pixel>>; 2],
}

/// Detects rests in the samples and stores them.
#[derive(Clone, Debug)]
pub struct Recorder {
    dh: Dh,
    rests: Vec<Rest>,
    window: Vec<Sample>,
    /// Time at which the arm came to rest; `None` while it moves.
    since: Option<f64>,
    /// This rest is already stored or skipped.
    decided: bool,
}

impl Recorder {
    /// Creates a recorder for an arm with these kinematics.
    pub fn new(dh: Dh) -> Self {
        Self { dh, rests: Vec::new(), window: Vec::new(), since: None, decided: false }
    }

    /// Number of stored rests.
    pub fn rests(&self) -> usize {
        self.rests.len()
    }

    /// Processes a sample.
    pub fn offer(&mut self, s: Sample) -> Event {
        let moved = |a: &Joints, b: &Joints| a.iter().zip(b).any(|(a, b)| (a - b).abs() > MAX_REST_TRAVEL_RAD);
        let finite = s.q.iter().chain(&s.qd).all(|v| v.is_finite());
        let still = finite
            && s.qd.iter().all(|v| v.abs() < MAX_REST_SPEED_RAD_S)
            && self.window.first().is_none_or(|f| !moved(&f.q, &s.q));
        if !still {
            self.window.clear();
            self.since = None;
            self.decided = false;
            return Event::None;
        }
        let since = *self.since.get_or_insert(s.time_s);
        if self.window.is_empty() || s.time_s - since >= SETTLE_S {
            // The first sample is only the reference for the travel; it is not averaged.
            if !self.decided {
                self.window.push(s.clone());
            }
        }
        if self.decided || s.time_s - since < SETTLE_S + AVERAGE_S || self.window.len() <= MIN_SAMPLES {
            return Event::None;
        }
        self.decided = true;
        self.store()
    }

    fn store(&mut self) -> Event {
        let samples = &self.window[1..];
        let n = samples.len() as f64;
        let q: Joints = std::array::from_fn(|j| samples.iter().map(|s| s.q[j]).sum::<f64>() / n);
        let base_from_flange = self.dh.base_from_flange(&q);
        let near = |r: &Rest| {
            let d = r.base_from_flange.inv_mul(&base_from_flange);
            d.translation.vector.norm() < MIN_SEPARATION[0] && d.rotation.angle() < MIN_SEPARATION[1]
        };
        if let Some(k) = self.rests.iter().position(near) {
            return Event::Skipped(format!("same pose as rest {}; move the arm to another pose", k + 1));
        }
        let marks: [Vec<Option<Pixel>>; 2] = std::array::from_fn(|v| {
            let count = samples.iter().map(|s| s.marks[v].len()).max().unwrap_or(0);
            (0..count).map(|k| average(samples.iter().map(|s| s.marks[v].get(k).copied().flatten()), n)).collect()
        });
        let seen = [0, 1].map(|v| marks[v].iter().flatten().count());
        if seen.iter().any(|s| *s < MIN_MARKS) {
            return Event::Skipped(format!(
                "marks detected: {} left, {} right; at least {MIN_MARKS} are required in each image",
                seen[0], seen[1]
            ));
        }
        self.rests.push(Rest { q, base_from_flange, marks });
        Event::Stored(self.rests.len(), seen)
    }

    /// The recording so far, in the format that [`super::parse`] reads. `gripper` is the text of the gripper file, so
    /// that a calibrated file can be written from the recording alone. `stated` is copied to `noise` unchanged.
    pub fn to_json(&self, rig: &Rig, marks: &[Vec3], gripper: &str, assumed: Option<&Pose>, stated: Value) -> Value {
        let poses = self.rests.iter().map(|r| {
            let sightings = (0..marks.len()).filter_map(|k| {
                let px = |v: usize| r.marks[v].get(k).copied().flatten().map(|p| [p.x, p.y]);
                let (left, right) = (px(0), px(1));
                (left.is_some() || right.is_some()).then(|| json!({ "mark": k, "left": left, "right": right }))
            });
            let sightings: Vec<Value> = sightings.collect();
            json!({ "base_T_flange": matrix(&r.base_from_flange), "joints_rad": r.q, "marks": sightings })
        });
        let mut out = json!({
            "kind": "eye-to-hand",
            "units": { "length": "mm", "pixel": "centre of the top-left pixel is (0,0)" },
            "noise": stated,
            "rig": {
                "image_size": [rig.left.width, rig.left.height],
                "left": camera(&rig.left), "right": camera(&rig.right),
                "right_T_left": matrix(&rig.right_from_left),
            },
            "marks_mm": marks.iter().map(|m| [m.x * 1e3, m.y * 1e3, m.z * 1e3]).collect::<Vec<_>>(),
            "gripper_toml": gripper,
            "poses": poses.collect::<Vec<_>>(),
        });
        if let Some(x) = assumed {
            out["assumed_flange_T_gripper"] = json!(matrix(x));
        }
        out
    }
}

/// Mean of the detected pixels; `None` if there are too few.
fn average(px: impl Iterator<Item = Option<Pixel>>, n: f64) -> Option<Pixel> {
    let (mut sum, mut count) = (Pixel::zeros(), 0.0);
    for p in px.flatten().filter(|p| p.x.is_finite() && p.y.is_finite()) {
        sum += p;
        count += 1.0;
    }
    (count >= MIN_SEEN_FRACTION * n).then(|| sum / count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use graspd_rt::arm::Model;

    fn sample(time_s: f64, q0: f64, speed: f64, marks: usize) -> Sample {
        let q = [q0, -1.2, 1.3, -1.6, -1.5, 0.2];
        let jitter = 0.1 * (50.0 * time_s).sin();
        let seen: Vec<Option<Pixel>> =
            (0..6).map(|k| (k < marks).then(|| Pixel::new(100.0 + 10.0 * k as f64 + jitter, 200.0))).collect();
        Sample { time_s, q, qd: [speed, 0.0, 0.0, 0.0, 0.0, 0.0], marks: [seen.clone(), seen] }
    }

    /// Offers two seconds of samples at one pose.
    fn rest(r: &mut Recorder, start: f64, q0: f64, marks: usize) -> Vec<Event> {
        let events = (0..100).map(|k| r.offer(sample(start + 0.02 * f64::from(k), q0, 0.0, marks)));
        events.filter(|e| *e != Event::None).collect()
    }

    #[test]
    fn a_rest_is_stored_once_and_samples_in_motion_are_ignored() {
        let mut r = Recorder::new(Model::Ur5e.dh());
        for k in 0..200 {
            let t = 0.02 * f64::from(k);
            assert_eq!(r.offer(sample(t, 0.1 * t, 0.1, 6)), Event::None);
        }
        assert_eq!(rest(&mut r, 4.0, 0.4, 6), [Event::Stored(1, [6, 6])]);
        // Same pose after a short motion: not a new rest.
        r.offer(sample(6.0, 0.4, 0.05, 6));
        assert!(matches!(&rest(&mut r, 6.1, 0.4, 6)[..], [Event::Skipped(why)] if why.contains("rest 1")));
        r.offer(sample(8.2, 0.5, 0.05, 6));
        assert!(matches!(&rest(&mut r, 8.3, 0.6, 2)[..], [Event::Skipped(why)] if why.contains("2 left")));
        r.offer(sample(10.4, 0.7, 0.05, 6));
        assert_eq!(rest(&mut r, 10.5, 0.8, 5), [Event::Stored(2, [5, 5])]);
    }

    #[test]
    fn slow_drift_is_not_a_rest() {
        let mut r = Recorder::new(Model::Ur5e.dh());
        for k in 0..500 {
            let t = 0.02 * f64::from(k);
            // 1 mrad/s is below the speed limit of a rest.
            assert_eq!(r.offer(sample(t, 1e-3 * t, 1e-3, 6)), Event::None);
        }
    }
}
