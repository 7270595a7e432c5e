//! Recording: marks and joints whenever the arm is at rest. Nothing here moves anything.

use super::report::{camera, matrix};
use graspd_rt::arm::{Dh, Joints};
use graspd_rt::geom::{Pixel, Pose, Rig, Vec3};
use serde_json::{Value, json};

/// Joint speed below which a joint rests, rad/s: what a controller reports of a joint that holds is ten times less.
const STILL: f64 = 2e-3;
/// Joint travel within one rest, rad: 0.01 degrees, half of what an arm repeats to.
const DRIFT: f64 = 1.7e-4;
/// Time after the last motion until vibrations and the pipeline from exposure to telemetry have died away, seconds.
const SETTLE: f64 = 0.5;
/// Time over which a rest is averaged, seconds.
const AVERAGE: f64 = 1.0;
/// Samples of a rest at least: half of what fifty telemetry samples a second give.
const LEAST_SAMPLES: usize = 20;
/// Travel of the flange that makes another rest: metres, rad.
const ANOTHER: [f64; 2] = [5e-3, 0.03];
/// A mark is recorded when it was seen in this share of the samples.
const SEEN: f64 = 0.5;
/// A rest needs this many marks in each image.
const LEAST_MARKS: usize = 3;

/// What one telemetry sample says.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample {
    /// Clock of the sample, seconds.
    pub time_s: f64,
    /// Joint positions, rad.
    pub q: Joints,
    /// Joint velocities, rad/s.
    pub qd: Joints,
    /// Marks by view and index; `None` where not seen.
    pub marks: [Vec<Option<Pixel>>; 2],
}

/// What came of a sample.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// Nothing to say.
    None,
    /// A rest was stored: its number, counted from 1, and the marks it has in the left and the right image.
    Stored(usize, [usize; 2]),
    /// A rest was not stored, with the reason in words.
    Passed(String),
}

/// A stored rest.
#[derive(Clone, Debug, PartialEq)]
struct Rest {
    q: Joints,
    base_from_flange: Pose,
    marks: [Vec<Option<Pixel>>; 2],
}

/// Watches samples and stores rests.
#[derive(Clone, Debug)]
pub struct Recorder {
    dh: Dh,
    rests: Vec<Rest>,
    window: Vec<Sample>,
    /// When the arm came to rest; `None` while it moves or once this rest is dealt with.
    since: Option<f64>,
    dealt: bool,
}

impl Recorder {
    /// Records an arm of this table.
    pub fn new(dh: Dh) -> Self {
        Self { dh, rests: Vec::new(), window: Vec::new(), since: None, dealt: false }
    }

    /// Number of rests stored.
    pub fn rests(&self) -> usize {
        self.rests.len()
    }

    /// Takes a sample.
    pub fn offer(&mut self, s: Sample) -> Event {
        let moved = |a: &Joints, b: &Joints| a.iter().zip(b).any(|(a, b)| (a - b).abs() > DRIFT);
        let finite = s.q.iter().chain(&s.qd).all(|v| v.is_finite());
        let still =
            finite && s.qd.iter().all(|v| v.abs() < STILL) && self.window.first().is_none_or(|f| !moved(&f.q, &s.q));
        if !still {
            self.window.clear();
            self.since = None;
            self.dealt = false;
            return Event::None;
        }
        let since = *self.since.get_or_insert(s.time_s);
        if self.window.is_empty() || s.time_s - since >= SETTLE {
            // The first sample only holds the place; it is dropped before averaging.
            if !self.dealt {
                self.window.push(s.clone());
            }
        }
        if self.dealt || s.time_s - since < SETTLE + AVERAGE || self.window.len() <= LEAST_SAMPLES {
            return Event::None;
        }
        self.dealt = true;
        self.store()
    }

    fn store(&mut self) -> Event {
        let samples = &self.window[1..];
        let n = samples.len() as f64;
        let q: Joints = std::array::from_fn(|j| samples.iter().map(|s| s.q[j]).sum::<f64>() / n);
        let base_from_flange = self.dh.base_from_flange(&q);
        let near = |r: &Rest| {
            let d = r.base_from_flange.inv_mul(&base_from_flange);
            d.translation.vector.norm() < ANOTHER[0] && d.rotation.angle() < ANOTHER[1]
        };
        if let Some(k) = self.rests.iter().position(near) {
            return Event::Passed(format!("the arm stands where it stood at rest {}; move on", k + 1));
        }
        let marks: [Vec<Option<Pixel>>; 2] = std::array::from_fn(|v| {
            let count = samples.iter().map(|s| s.marks[v].len()).max().unwrap_or(0);
            (0..count).map(|k| average(samples.iter().map(|s| s.marks[v].get(k).copied().flatten()), n)).collect()
        });
        let seen = [0, 1].map(|v| marks[v].iter().flatten().count());
        if seen.iter().any(|s| *s < LEAST_MARKS) {
            return Event::Passed(format!(
                "marks seen: {} left, {} right; at least {LEAST_MARKS} in each are needed",
                seen[0], seen[1]
            ));
        }
        self.rests.push(Rest { q, base_from_flange, marks });
        Event::Stored(self.rests.len(), seen)
    }

    /// The recording so far, in the form that [`super::parse`] reads. `gripper` is the text of the gripper file, so
    /// that a calibrated one can be written from the recording alone; `stated` is put into `noise` as it is.
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

/// Mean of the pixels that were seen; `None` when they were too few.
fn average(px: impl Iterator<Item = Option<Pixel>>, n: f64) -> Option<Pixel> {
    let (mut sum, mut count) = (Pixel::zeros(), 0.0);
    for p in px.flatten().filter(|p| p.x.is_finite() && p.y.is_finite()) {
        sum += p;
        count += 1.0;
    }
    (count >= SEEN * n).then(|| sum / count)
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

    /// Runs two seconds at one place.
    fn rest(r: &mut Recorder, start: f64, q0: f64, marks: usize) -> Vec<Event> {
        let events = (0..100).map(|k| r.offer(sample(start + 0.02 * f64::from(k), q0, 0.0, marks)));
        events.filter(|e| *e != Event::None).collect()
    }

    #[test]
    fn a_rest_is_stored_once_and_motion_never() {
        let mut r = Recorder::new(Model::Ur5e.dh());
        for k in 0..200 {
            let t = 0.02 * f64::from(k);
            assert_eq!(r.offer(sample(t, 0.1 * t, 0.1, 6)), Event::None);
        }
        assert_eq!(rest(&mut r, 4.0, 0.4, 6), [Event::Stored(1, [6, 6])]);
        // Still there after a twitch: the same place is not another rest.
        r.offer(sample(6.0, 0.4, 0.05, 6));
        assert!(matches!(&rest(&mut r, 6.1, 0.4, 6)[..], [Event::Passed(why)] if why.contains("rest 1")));
        r.offer(sample(8.2, 0.5, 0.05, 6));
        assert!(matches!(&rest(&mut r, 8.3, 0.6, 2)[..], [Event::Passed(why)] if why.contains("2 left")));
        r.offer(sample(10.4, 0.7, 0.05, 6));
        assert_eq!(rest(&mut r, 10.5, 0.8, 5), [Event::Stored(2, [5, 5])]);
    }

    #[test]
    fn a_slow_creep_is_no_rest() {
        let mut r = Recorder::new(Model::Ur5e.dh());
        for k in 0..500 {
            let t = 0.02 * f64::from(k);
            // A milliradian a second is below the speed that counts as motion.
            assert_eq!(r.offer(sample(t, 1e-3 * t, 1e-3, 6)), Event::None);
        }
    }
}
