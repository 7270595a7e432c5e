//! Two inexpensive checks of an image's content: whether it repeats, and whether it is exposed.

use super::StereoFrame;
use super::pose::MarkTable;
use crate::geom::View;
use crate::gripper::MAX_MARKS;
use crate::image::ImageView;

/// Detects an image that repeats byte by byte while its sequence number advances.
///
/// A few rows around each mark are hashed, at the marks' positions *when the content last changed*: windows that follow
/// the prediction would move with the arm, and a frozen image would seem to change. The noise of a live camera changes
/// the hash in every frame, so a run of equal hashes is a frozen image. The caller decides whether that is a fault (the
/// arm moves).
#[derive(Clone, Debug)]
pub(crate) struct FreezeWatch {
    anchors: [[Option<(u16, u16)>; MAX_MARKS]; 2],
    hash: u64,
    run: u32,
}

/// Half height of the hashed window, pixels.
const HALF_ROWS: usize = 4;
/// Half width of the hashed window, pixels.
const HALF_COLUMNS: usize = 12;

impl FreezeWatch {
    pub(crate) const fn new() -> Self {
        Self { anchors: [[None; MAX_MARKS]; 2], hash: 0, run: 0 }
    }

    /// Number of consecutive frames equal to the one before.
    pub(crate) fn run(&self) -> u32 {
        self.run
    }

    /// Updates the run with a frame and the marks measured in it.
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
        // FNV-1a over groups of eight pixels: byte by byte, it would take as long as the pose.
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

/// Whether an image is black, saturated, or without contrast, from about a thousand of its pixels.
pub(crate) fn badly_exposed(image: &ImageView<'_>, min_contrast: f64) -> bool {
    const SIDE: usize = 32;
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
    // A dark background is not a fault, so 95 % of the pixels have to be black. Half of them saturated is a fault.
    black * 20 > all * 19 || white * 2 > all || f64::from(high.saturating_sub(low)) < min_contrast
}
