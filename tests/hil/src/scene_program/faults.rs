//! Camera and shared-memory faults on command (fault-catalogue numbers in brackets), each for a while or until cleared.

use graspd_shm::frame::{StereoHeader, flags};
use serde::{Deserialize, Serialize};

/// One fault, as a line of JSON names it: `{"fault":"skew","ms":8,"after_s":2,"for_s":1}`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "fault", rename_all = "snake_case", deny_unknown_fields)]
pub enum Fault {
    /// Same image again and again while stamps and sequence go on (C03); `eye` 0 left, 1 right, both without.
    Freeze {
        /// Which eye.
        #[serde(default)]
        eye: Option<usize>,
    },
    /// One eye's image and stamp stand still (C01); without `eye` nothing is published at all (C02).
    Stop {
        /// Which eye.
        #[serde(default)]
        eye: Option<usize>,
    },
    /// The sequence number repeats (C04).
    RepeatSequence {},
    /// The sequence number jumps back by `n` (C04).
    BackSequence {
        /// How far.
        n: u64,
    },
    /// Of every `every` pairs one is lost before publishing (C05).
    Drop {
        /// Period of the loss.
        every: u64,
    },
    /// The right eye is exposed earlier by `ms`, and says so (C06).
    Skew {
        /// Milliseconds.
        ms: f64,
    },
    /// Left and right images change places; with `ids` the camera ids as well (C07).
    Swap {
        /// Whether the ids go with the images.
        #[serde(default)]
        ids: bool,
    },
    /// A header field lies [C08, H01, H02, H03]: `width`, `height`, `stride`, `pixel_format`, `magic`, `layout_version`,
    /// `header_size`, `offset`, `size`, `sequence_end`, `camera_id`, `calibration_id`, `flags`.
    Header {
        /// Field.
        field: String,
        /// Its value; for `offset`, `size` and `camera_id` the right eye's.
        value: u64,
    },
    /// Part of an image is missing; flagged unless `silent` (C09).
    Incomplete {
        /// Which eye.
        #[serde(default)]
        eye: usize,
        /// Do not flag it.
        #[serde(default)]
        silent: bool,
    },
    /// Capture stamps are off by `ms`, positive into the future (C10); `drift_ppm` lets them run away (C11).
    Stamp {
        /// Constant part, milliseconds.
        #[serde(default)]
        ms: f64,
        /// Growing part, parts per million.
        #[serde(default)]
        drift_ppm: f64,
    },
    /// Greys are multiplied: 0 is black, 1 as it was, 10 saturated (C12). `period_s` lets the exposure hunt.
    Gain {
        /// Factor.
        factor: f64,
        /// Period of a sine between 1 and `factor`; 0 for steady.
        #[serde(default)]
        period_s: f64,
    },
    /// Fog: contrast shrinks towards `grey` by `share` (C12).
    Fog {
        /// Share of the fog, 0 to 1.
        share: f64,
        /// Its grey.
        #[serde(default = "mid_grey")]
        grey: f64,
    },
    /// Defocus: a box blur of half width `px` (C13).
    Blur {
        /// Half width, pixels.
        px: usize,
    },
    /// A camera is knocked: moved along x by `mm` and turned about y by `deg` (C14). Takes a second to show.
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
    /// The valve is moved by `mm` along its x axis after the plan was made (G07). Takes a second to show.
    MoveObject {
        /// Millimetres.
        mm: f64,
    },
    /// Another rate (C16).
    Rate {
        /// Pairs a second.
        hz: f64,
    },
    /// A mark is painted over in both views [M01, M02]; several by several faults.
    OccludeMark {
        /// Which mark, from 0.
        mark: usize,
    },
    /// Everything of the gripper is hidden (M02).
    HideGripper {},
    /// Two marks change places in the images: each window shows the other's surroundings (M03).
    SwapMarks {
        /// One.
        a: usize,
        /// The other.
        b: usize,
    },
    /// A disc that is no mark, `du`, `dv` pixels from a mark (M04).
    Blob {
        /// Which mark.
        #[serde(default)]
        mark: usize,
        /// Pixels to the right.
        du: f64,
        /// Pixels down.
        dv: f64,
        /// Radius, pixels.
        #[serde(default = "blob_radius")]
        radius: f64,
        /// Grey.
        #[serde(default)]
        grey: u8,
    },
    /// The gripper appears elsewhere, by `mm` along its x axis (M05).
    Teleport {
        /// Millimetres.
        mm: f64,
    },
    /// One view is shifted by whole pixels (M08).
    Shift {
        /// Which eye.
        #[serde(default)]
        eye: usize,
        /// Pixels to the right.
        du: i64,
        /// Pixels down.
        dv: i64,
    },
    /// The gripper's image stands still while the arm moves; noise goes on (M09).
    HoldPose {},
    /// White noise instead of images (M07).
    WhiteNoise {},
    /// A second publisher sends pairs of its own (H06).
    SecondPublisher {},
}

fn mid_grey() -> f64 {
    160.0
}

fn blob_radius() -> f64 {
    6.0
}

/// A fault with its time.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Timed {
    pub(super) fault: Fault,
    /// From and until, CLOCK_MONOTONIC nanoseconds.
    pub(super) from_ns: u64,
    pub(super) until_ns: u64,
}

impl Timed {
    /// Reads a fault's JSON object; `after_s` and `for_s` are its own keys for when and how long.
    pub(super) fn parse(value: &serde_json::Value, now_ns: u64) -> Result<Self, String> {
        let mut map = value.as_object().cloned().ok_or("a fault is a JSON object")?;
        let mut seconds = |key: &str, default: f64| match map.remove(key) {
            None => Ok(default),
            Some(v) => v.as_f64().filter(|s| *s >= 0.0 && *s < 1e9).ok_or(format!("`{key}`: give seconds, at least 0")),
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
    /// Changes a finished image (eye 0 or 1) of `w` times `h` bytes.
    pub(super) fn spoil(&self, eye: usize, image: &mut [u8], w: usize, h: usize, t_s: f64, key: u64) {
        match self {
            Fault::Incomplete { eye: e, .. } if *e == eye => {
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
            Fault::Shift { eye: e, du, dv } if *e == eye => shift(image, w, h, *du, *dv),
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

    /// Changes a header.
    pub(super) fn lie(&self, h: &mut StereoHeader, t_s: f64) {
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

/// Paints a disc with soft edges.
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
    fn faults_are_read_from_json_with_their_time() {
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
    fn images_are_spoilt_as_the_fault_says() {
        let (w, h) = (40, 30);
        let fresh = || (0..w * h).map(|i| (i % 200) as u8).collect::<Vec<u8>>();
        let mut p = fresh();
        Fault::Gain { factor: 0.0, period_s: 0.0 }.spoil(0, &mut p, w, h, 0.0, 1);
        assert!(p.iter().all(|g| *g == 0));
        let mut p = fresh();
        Fault::Shift { eye: 1, du: 3, dv: -2 }.spoil(1, &mut p, w, h, 0.0, 1);
        assert_eq!(p[10 * w + 10], fresh()[12 * w + 7]);
        let mut p = fresh();
        Fault::Shift { eye: 1, du: 3, dv: -2 }.spoil(0, &mut p, w, h, 0.0, 1);
        assert_eq!(p, fresh());
        let mut p = vec![100; w * h];
        Fault::Blur { px: 3 }.spoil(0, &mut p, w, h, 0.0, 1);
        assert!(p.iter().all(|g| *g == 100));
        disc(&mut p, w, h, (20.0, 15.0), 4.0, 0);
        assert_eq!((p[15 * w + 20], p[15 * w + 30]), (0, 100));
    }
}
