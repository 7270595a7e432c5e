//! Two cheap looks at a picture's content: is it the same picture again, and is it exposed at all.

use super::StereoFrame;
use super::pose::MarkTable;
use crate::geom::View;
use crate::gripper::MAX_MARKS;
use crate::image::ImageView;

/// Detects a picture that repeats byte by byte while its sequence number counts (fault C03).
///
/// A few rows about each mark are hashed *where the marks were when the content last changed*: were the windows to follow the
/// prediction, a moving arm would make a frozen picture look new. A live camera's noise changes the hash at every frame, so
/// that a run of equal ones says that the picture is frozen; whether that is a fault (the arm moves) the command side decides.
#[derive(Clone, Debug)]
pub(crate) struct FreezeWatch {
    anchors: [[Option<(u16, u16)>; MAX_MARKS]; 2],
    hash: u64,
    run: u32,
}

const HALF_ROWS: usize = 4;
const HALF_COLUMNS: usize = 12;

impl FreezeWatch {
    pub(crate) const fn new() -> Self {
        Self { anchors: [[None; MAX_MARKS]; 2], hash: 0, run: 0 }
    }

    /// Number of frames in a row that equalled the one before.
    pub(crate) fn run(&self) -> u32 {
        self.run
    }

    /// Takes in a frame and the marks seen in it.
    pub(crate) fn update(&mut self, frame: &StereoFrame<'_>, marks: &MarkTable) {
        let anchored = self.anchors.iter().flatten().any(Option::is_some);
        if anchored && self.digest(frame) == self.hash {
            self.run = self.run.saturating_add(1);
            return;
        }
        self.run = 0;
        for (anchors, marks) in self.anchors.iter_mut().zip(marks) {
            for (a, m) in anchors.iter_mut().zip(marks) {
                *a = m.map(|m| (m.pixel.x.clamp(0.0, 65_535.0) as u16, m.pixel.y.clamp(0.0, 65_535.0) as u16));
            }
        }
        self.hash = self.digest(frame);
    }

    fn digest(&self, frame: &StereoFrame<'_>) -> u64 {
        // FNV-1a over words of eight pixels: a byte at a time it would cost as much as the pose.
        let mut h = 0xcbf2_9ce4_8422_2325_u64;
        for view in View::BOTH {
            let image = frame.image(view);
            for (x, y) in self.anchors[view.index()].iter().flatten() {
                let (x, y) = (usize::from(*x), usize::from(*y));
                for row in y.saturating_sub(HALF_ROWS)..=y + HALF_ROWS {
                    let from = x.saturating_sub(HALF_COLUMNS).min(image.width());
                    let to = (x + HALF_COLUMNS).min(image.width());
                    let (words, rest) = image.row(row).get(from..to).unwrap_or(&[]).as_chunks::<8>();
                    for w in words {
                        h = (h ^ u64::from_le_bytes(*w)).wrapping_mul(0x0000_0100_0000_01b3);
                        h ^= h >> 32;
                    }
                    for b in rest {
                        h = (h ^ u64::from(*b)).wrapping_mul(0x0000_0100_0000_01b3);
                    }
                }
            }
        }
        h
    }
}

/// Whether a picture is black, saturated, or without contrast (fault C12), from a few hundred of its pixels.
pub(crate) fn badly_exposed(image: &ImageView<'_>, min_contrast: f64) -> bool {
    const SIDE: usize = 16;
    let (mut black, mut white, mut low, mut high) = (0_u32, 0_u32, 255_u8, 0_u8);
    for j in 0..SIDE {
        let row = image.row((2 * j + 1) * image.height() / (2 * SIDE));
        for i in 0..SIDE {
            let v = row.get((2 * i + 1) * image.width() / (2 * SIDE)).copied().unwrap_or(0);
            black += u32::from(v <= 2);
            white += u32::from(v >= 253);
            low = low.min(v);
            high = high.max(v);
        }
    }
    let all = (SIDE * SIDE) as u32;
    // A dark room behind the part is no fault, hence nearly all for black; half of a picture burnt out is one.
    black * 20 > all * 19 || white * 2 > all || f64::from(high.saturating_sub(low)) < min_contrast
}
