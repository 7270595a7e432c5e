//! Faults of the cameras and of the shared memory, each active for a time or until cleared.

use graspd_shm::frame::{StereoHeader, flags};
use serde::{Deserialize, Serialize};

/// One fault. As a line of JSON: `{"fault":"skew","ms":8,"after_s":2,"for_s":1}`. `eye` selects a camera: 0 left, 1
/// right.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "fault", rename_all = "snake_case", deny_unknown_fields)]
pub enum Fault {
    /// Repeats the same image while time stamps and sequence numbers continue.
    Freeze {
        /// Camera; both if omitted.
        #[serde(default)]
        eye: Option<usize>,
    },
    /// Repeats image and time stamp of one camera; without `eye` nothing is published.
    Stop {
        /// Camera; both if omitted.
        #[serde(default)]
        eye: Option<usize>,
    },
    /// Repeats the sequence number.
    RepeatSequence {},
    /// Sets the sequence number back.
    BackSequence {
        /// By how much.
        n: u64,
    },
    /// Loses one of every `every` pairs before publishing.
    Drop {
        /// Period of the loss.
        every: u64,
    },
    /// Exposes the right camera earlier by `ms`, with a matching time stamp.
    Skew {
        /// Milliseconds.
        ms: f64,
    },
    /// Exchanges left and right images, with `ids` also the camera ids.
    Swap {
        /// Whether the camera ids are exchanged.
        #[serde(default)]
        ids: bool,
    },
    /// Writes a wrong value into a header field: `width`, `height`, `stride`, `pixel_format`, `magic`,
    /// `layout_version`, `header_size`, `offset`, `size`, `sequence_end`, `camera_id`, `calibration_id`, `flags`.
    Header {
        /// Field.
        field: String,
        /// Its value; for `offset`, `size` and `camera_id` that of the right camera.
        value: u64,
    },
    /// A part of an image is missing; flagged unless `silent`.
    Incomplete {
        /// Which eye.
        #[serde(default)]
        eye: usize,
        /// Whether the flag is omitted.
        #[serde(default)]
        silent: bool,
    },
    /// Capture time stamps have an offset `ms` (positive: in the future) and a drift.
    Stamp {
        /// Offset, milliseconds.
        #[serde(default)]
        ms: f64,
        /// Drift, parts per million.
        #[serde(default)]
        drift_ppm: f64,
    },
    /// Multiplies the grey values: 0 is black, 1 unchanged, 10 saturated. With `period_s` the exposure oscillates.
    Gain {
        /// Factor.
        factor: f64,
        /// Period of an oscillation between 1 and `factor`, s; 0 for a constant factor.
        #[serde(default)]
        period_s: f64,
    },
    /// Fog: contrast is reduced towards `grey` by the fraction `share`.
    Fog {
        /// Fraction of the fog, 0 to 1.
        share: f64,
        /// Its grey value.
        #[serde(default = "mid_grey")]
        grey: f64,
    },
    /// Defocus: a box blur of half width `px`.
    Blur {
        /// Half width, pixels.
        px: usize,
    },
    /// Displaces a camera: along x by `mm` and about y by `deg`. Takes effect after about a second.
    KnockCamera {
        /// Which eye.
        #[serde(default)]
        eye: usize,
        /// Millimetres.
        #[serde(default)]
        mm: f64,
        /// Degrees.
        #[serde(default)]
        deg: f64,
    },
    /// Moves the valve by `mm` along its x axis. Takes effect after about a second.
    MoveObject {
        /// Millimetres.
        mm: f64,
    },
    /// Another rate.
    Rate {
        /// Pairs per second.
        hz: f64,
    },
    /// Paints over a mark in both images; several marks need several faults.
    OccludeMark {
        /// Mark, from 0.
        mark: usize,
    },
    /// Hides the whole gripper.
    HideGripper {},
    /// Exchanges the windows around two marks in the images.
    SwapMarks {
        /// First mark.
        a: usize,
        /// Second mark.
        b: usize,
    },
    /// Draws a disc, which is not a mark, at `du`, `dv` pixels from a mark.
    Blob {
        /// Mark.
        #[serde(default)]
        mark: usize,
        /// Pixels to the right.
        du: f64,
        /// Pixels down.
        dv: f64,
        /// Radius, pixels.
        #[serde(default = "blob_radius")]
        radius: f64,
        /// Grey value.
        #[serde(default)]
        grey: u8,
    },
    /// Draws the gripper displaced by `mm` along its x axis.
    Teleport {
        /// Millimetres.
        mm: f64,
    },
    /// Shifts one image by whole pixels.
    Shift {
        /// Which eye.
        #[serde(default)]
        eye: usize,
        /// Pixels to the right.
        du: i64,
        /// Pixels down.
        dv: i64,
    },
    /// Draws the gripper at a constant pose while the arm moves; the noise changes.
    HoldPose {},
    /// White noise instead of images.
    WhiteNoise {},
    /// A second publisher sends on the same topic.
    SecondPublisher {},
}

fn mid_grey() -> f64 {
    160.0
}

fn blob_radius() -> f64 {
    6.0
}

/// A fault and the time for which it is active.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Timed {
    pub(super) fault: Fault,
    /// Begin and end, CLOCK_MONOTONIC nanoseconds.
    pub(super) from_ns: u64,
    pub(super) until_ns: u64,
}

impl Timed {
    /// Parses a fault. The keys `after_s` and `for_s` are its delay and duration in seconds.
    pub(super) fn parse(value: &serde_json::Value, now_ns: u64) -> Result<Self, String> {
        let mut map = value.as_object().cloned().ok_or("expected a JSON object")?;
        let mut seconds = |key: &str, default: f64| match map.remove(key) {
            None => Ok(default),
            Some(v) => {
                v.as_f64().filter(|s| *s >= 0.0 && *s < 1e9).ok_or(format!("`{key}`: expected seconds, at least 0"))
            }
        };
        let (after, length) = (seconds("after_s", 0.0)?, seconds("for_s", 1e9)?);
        let fault: Fault = serde_json::from_value(serde_json::Value::Object(map)).map_err(|e| e.to_string())?;
        let from_ns = now_ns + (after * 1e9) as u64;
        Ok(Self { fault, from_ns, until_ns: from_ns.saturating_add((length * 1e9) as u64) })
    }

    pub(super) fn active(&self, now_ns: u64) -> bool {
        (self.from_ns..self.until_ns).contains(&now_ns)
    }
}

impl Fault {
    /// Applies the fault to a rendered image of `w` times `h` bytes of camera 0 or 1.
    pub(super) fn degrade_image(&self, camera: usize, image: &mut [u8], w: usize, h: usize, t_s: f64, key: u64) {
        match self {
            Fault::Incomplete { eye, .. } if *eye == camera => {
                for row in image.chunks_exact_mut(w).skip(h / 2).step_by(3) {
                    row.fill(0);
                }
            }
            Fault::Gain { factor, period_s } => {
                let k = if *period_s > 0.0 {
                    1.0 + (factor - 1.0) * (0.5 - 0.5 * (std::f64::consts::TAU * t_s / period_s).cos())
                } else {
                    *factor
                };
                map(image, |g| g * k);
            }
            Fault::Fog { share, grey } => map(image, |g| g + share.clamp(0.0, 1.0) * (grey - g)),
            Fault::Blur { px } => box_blur(image, w, h, (*px).min(40)),
            Fault::Shift { eye, du, dv } if *eye == camera => shift(image, w, h, *du, *dv),
            Fault::WhiteNoise {} => {
                let mut k = key | 1;
                for p in image {
                    k ^= k << 13;
                    k ^= k >> 7;
                    k ^= k << 17;
                    *p = (k >> 24) as u8;
                }
            }
            _ => {}
        }
    }

    /// Applies the fault to a frame header.
    pub(super) fn corrupt_header(&self, h: &mut StereoHeader, t_s: f64) {
        match self {
            Fault::RepeatSequence {} => (h.sequence, h.sequence_end) = (1, 1),
            Fault::BackSequence { n } => {
                h.sequence = h.sequence.saturating_sub(*n);
                h.sequence_end = h.sequence;
            }
            Fault::Swap { ids: true } => h.camera_id.swap(0, 1),
            Fault::Incomplete { eye, silent: false } => {
                h.flags |= if *eye == 0 { flags::INCOMPLETE_LEFT } else { flags::INCOMPLETE_RIGHT };
            }
            Fault::Stamp { ms, drift_ppm } => {
                let off = ms * 1e6 + drift_ppm * 1e3 * t_s;
                h.capture_ns = h.capture_ns.map(|t| t.saturating_add_signed(off as i64));
            }
            Fault::Header { field, value } => {
                let (v, small) = (*value, *value as u32);
                match field.as_str() {
                    "magic" => h.magic = v,
                    "layout_version" => h.layout_version = small,
                    "header_size" => h.header_size = small,
                    "width" => h.width = small,
                    "height" => h.height = small,
                    "stride" => h.stride = small,
                    "pixel_format" => h.pixel_format = small,
                    "flags" => h.flags = small,
                    "offset" => h.offset[1] = v,
                    "size" => h.size[1] = v,
                    "sequence_end" => h.sequence_end = v,
                    "camera_id" => h.camera_id[1] = v,
                    "calibration_id" => h.calibration_id = v,
                    _ => {}
                }
            }
            _ => {}
        }
    }
}

fn map(image: &mut [u8], f: impl Fn(f64) -> f64) {
    let table: [u8; 256] = std::array::from_fn(|g| f(g as f64).round().clamp(0.0, 255.0) as u8);
    image.iter_mut().for_each(|p| *p = table[usize::from(*p)]);
}

fn box_blur(image: &mut [u8], w: usize, h: usize, half: usize) {
    let pass = |line: &mut dyn FnMut(usize) -> u8, n: usize, out: &mut Vec<u8>| {
        out.clear();
        let values: Vec<u32> = (0..n).map(|i| u32::from(line(i))).collect();
        for i in 0..n {
            let (a, b) = (i.saturating_sub(half), (i + half + 1).min(n));
            out.push((values[a..b].iter().sum::<u32>() / (b - a) as u32) as u8);
        }
    };
    let mut out = Vec::new();
    for row in image.chunks_exact_mut(w) {
        pass(&mut |i| row[i], w, &mut out);
        row.copy_from_slice(&out);
    }
    for x in 0..w {
        pass(&mut |y| image[y * w + x], h, &mut out);
        for (y, v) in out.iter().enumerate() {
            image[y * w + x] = *v;
        }
    }
}

fn shift(image: &mut [u8], w: usize, h: usize, du: i64, dv: i64) {
    let src = image.to_vec();
    let at = |v: usize, d: i64, n: usize| (v as i64 - d).clamp(0, n as i64 - 1) as usize;
    for y in 0..h {
        for x in 0..w {
            image[y * w + x] = src[at(y, dv, h) * w + at(x, du, w)];
        }
    }
}

/// Paints an antialiased disc.
pub(super) fn disc(image: &mut [u8], w: usize, h: usize, centre: (f64, f64), radius: f64, grey: u8) {
    let reach = |c: f64, n: usize| {
        (
            (c - radius - 1.0).floor().clamp(0.0, n as f64) as usize,
            (c + radius + 2.0).ceil().clamp(0.0, n as f64) as usize,
        )
    };
    let ((x0, x1), (y0, y1)) = (reach(centre.0, w), reach(centre.1, h));
    for y in y0..y1 {
        for x in x0..x1 {
            let k = (radius + 0.5 - (x as f64 - centre.0).hypot(y as f64 - centre.1)).clamp(0.0, 1.0);
            let p = &mut image[y * w + x];
            *p = (f64::from(*p) * (1.0 - k) + f64::from(grey) * k).round() as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faults_are_parsed_from_json_with_their_times() {
        let t = Timed::parse(&serde_json::json!({"fault":"skew","ms":8,"after_s":2,"for_s":1}), 1_000_000_000).unwrap();
        assert_eq!(t.fault, Fault::Skew { ms: 8.0 });
        assert!(!t.active(2_900_000_000) && t.active(3_100_000_000) && !t.active(4_100_000_000));
        for (bad, part) in [
            (serde_json::json!({"fault":"skow"}), "skow"),
            (serde_json::json!({"fault":"skew"}), "ms"),
            (serde_json::json!({"fault":"skew","ms":8,"mss":1}), "mss"),
            (serde_json::json!({"fault":"freeze","after_s":-1}), "after_s"),
        ] {
            let e = Timed::parse(&bad, 0).unwrap_err();
            assert!(e.contains(part), "{e}");
        }
    }

    #[test]
    fn image_faults_change_the_pixels_they_name() {
        let (w, h) = (40, 30);
        let fresh = || (0..w * h).map(|i| (i % 200) as u8).collect::<Vec<u8>>();
        let mut p = fresh();
        Fault::Gain { factor: 0.0, period_s: 0.0 }.degrade_image(0, &mut p, w, h, 0.0, 1);
        assert!(p.iter().all(|g| *g == 0));
        let mut p = fresh();
        Fault::Shift { eye: 1, du: 3, dv: -2 }.degrade_image(1, &mut p, w, h, 0.0, 1);
        assert_eq!(p[10 * w + 10], fresh()[12 * w + 7]);
        let mut p = fresh();
        Fault::Shift { eye: 1, du: 3, dv: -2 }.degrade_image(0, &mut p, w, h, 0.0, 1);
        assert_eq!(p, fresh());
        let mut p = vec![100; w * h];
        Fault::Blur { px: 3 }.degrade_image(0, &mut p, w, h, 0.0, 1);
        assert!(p.iter().all(|g| *g == 100));
        disc(&mut p, w, h, (20.0, 15.0), 4.0, 0);
        assert_eq!((p[15 * w + 20], p[15 * w + 30]), (0, 100));
    }
}
