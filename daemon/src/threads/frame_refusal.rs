//! Why the vision thread refused a stereo pair: a number between threads, a text for people.

use graspd_rt::online::FrameReject;
use graspd_shm::frame::FrameError;

/// Why a stereo pair was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameRefusal {
    /// By the checks of the frame topic.
    Topic(FrameError),
    /// By the tracker.
    Tracker(FrameReject),
    /// The payload does not hold the images that the header describes.
    Images,
    /// The image repeats byte by byte while the arm moves.
    Frozen,
}

/// The tracker's reasons, by their number less [`FIRST_TRACKER`].
const TRACKER: [&str; 7] = [
    "the image size differs from the rig's camera: publish full images of the calibrated camera",
    "the sequence number repeats or goes back",
    "a capture stamp does not advance",
    "left and right were exposed too far apart: check the cameras' trigger (vision.max_skew_ms)",
    "the pair is too old",
    "a capture stamp is in the future: stamps are CLOCK_MONOTONIC nanoseconds",
    "the marks are farther from their last position than the gripper can have moved",
];
const FIRST_TOPIC: u32 = 1;
const FIRST_TRACKER: u32 = 100;
const IMAGES: u32 = 200;
const FROZEN: u32 = 201;

impl FrameRefusal {
    /// The number that an atomic holds for this reason; never 0.
    pub fn number(self) -> u32 {
        match self {
            FrameRefusal::Topic(r) => FIRST_TOPIC + r as u32,
            FrameRefusal::Tracker(r) => {
                FIRST_TRACKER
                    + match r {
                        FrameReject::Size { .. } => 0,
                        FrameReject::Sequence { .. } => 1,
                        FrameReject::NotLater { .. } => 2,
                        FrameReject::Skew { .. } => 3,
                        FrameReject::Stale { .. } => 4,
                        FrameReject::Future { .. } => 5,
                        FrameReject::Jump { .. } => 6,
                    }
            }
            FrameRefusal::Images => IMAGES,
            FrameRefusal::Frozen => FROZEN,
        }
    }

    /// The text for a number; empty for 0.
    pub fn text(number: u32) -> String {
        match number {
            0 => String::new(),
            IMAGES => "the payload does not hold the images that the header describes".to_owned(),
            FROZEN => "the image repeats while the arm moves: the camera or its driver is frozen".to_owned(),
            n => {
                let topic =
                    n.checked_sub(FIRST_TOPIC).and_then(|i| FrameError::ALL.get(i as usize)).map(ToString::to_string);
                let tracker =
                    n.checked_sub(FIRST_TRACKER).and_then(|i| TRACKER.get(i as usize)).map(|t| (*t).to_owned());
                topic.or(tracker).unwrap_or_else(|| format!("reason {n}"))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_refusal_has_its_own_number_and_text() {
        let mut seen = std::collections::BTreeSet::new();
        let topic = FrameError::ALL.map(FrameRefusal::Topic);
        let tracker = [
            FrameReject::Sequence { last: 1, got: 1 },
            FrameReject::Skew { ns: 1 },
            FrameReject::Stale { ns: 1 },
            FrameReject::Future { ns: 1 },
            FrameReject::Jump { um: 1, mrad: 1 },
        ]
        .map(FrameRefusal::Tracker);
        for r in topic.into_iter().chain(tracker).chain([FrameRefusal::Images, FrameRefusal::Frozen]) {
            let text = FrameRefusal::text(r.number());
            assert!(text.len() > 10 && !text.starts_with("reason"), "{r:?}: {text}");
            seen.insert(r.number());
        }
        assert_eq!(seen.len(), FrameError::ALL.len() + 7);
        assert_eq!(FrameRefusal::text(0), "");
    }
}
