//! Why the vision thread refused a pair: one number across threads, words for people.

use graspd_rt::online::FrameReject;
use graspd_shm::frame::FrameError;

/// Why a pair was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// By the checks of the frame topic.
    Topic(FrameError),
    /// By the tracker.
    Tracker(FrameReject),
    /// Its payload does not hold the images that its header promises.
    Images,
    /// The image repeats byte by byte while the arm moves (C03).
    Frozen,
}

const TRACKER: [&str; 7] = [
    "an image has not the size of the rig's camera",
    "the sequence number repeats or goes back",
    "a capture stamp does not advance",
    "left and right were exposed too far apart: check the cameras' trigger (vision.max_skew_ms)",
    "the pair is too old",
    "a capture stamp lies in the future: stamps are CLOCK_MONOTONIC nanoseconds",
    "the marks are farther from their last place than the gripper can have moved",
];
const IMAGES: u32 = 200;
const FROZEN: u32 = 201;

impl Refusal {
    /// A number for an atomic: never 0.
    pub fn number(self) -> u32 {
        match self {
            Refusal::Topic(r) => 1 + r as u32,
            Refusal::Tracker(r) => {
                100 + match r {
                    FrameReject::Size { .. } => 0,
                    FrameReject::Sequence { .. } => 1,
                    FrameReject::NotLater { .. } => 2,
                    FrameReject::Skew { .. } => 3,
                    FrameReject::Stale { .. } => 4,
                    FrameReject::Future { .. } => 5,
                    FrameReject::Jump { .. } => 6,
                }
            }
            Refusal::Images => IMAGES,
            Refusal::Frozen => FROZEN,
        }
    }

    /// The words of a number; empty for 0.
    pub fn words(number: u32) -> String {
        match number {
            0 => String::new(),
            IMAGES => "the payload does not hold the images that the header promises".to_owned(),
            FROZEN => "the image repeats while the arm moves: the camera or its driver is frozen".to_owned(),
            n => {
                let topic = n.checked_sub(1).and_then(|i| FrameError::ALL.get(i as usize)).map(ToString::to_string);
                let tracker = n.checked_sub(100).and_then(|i| TRACKER.get(i as usize)).map(|w| (*w).to_owned());
                topic.or(tracker).unwrap_or_else(|| format!("reason {n}"))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_refusal_has_words_of_its_own() {
        let mut seen = std::collections::BTreeSet::new();
        let topic = FrameError::ALL.map(Refusal::Topic);
        let tracker = [
            FrameReject::Sequence { last: 1, got: 1 },
            FrameReject::Skew { ns: 1 },
            FrameReject::Stale { ns: 1 },
            FrameReject::Future { ns: 1 },
            FrameReject::Jump { um: 1, mrad: 1 },
        ]
        .map(Refusal::Tracker);
        for r in topic.into_iter().chain(tracker).chain([Refusal::Images, Refusal::Frozen]) {
            let words = Refusal::words(r.number());
            assert!(words.len() > 10 && !words.starts_with("reason"), "{r:?}: {words}");
            seen.insert(r.number());
        }
        assert_eq!(seen.len(), FrameError::ALL.len() + 7);
        assert_eq!(Refusal::words(0), "");
    }
}
