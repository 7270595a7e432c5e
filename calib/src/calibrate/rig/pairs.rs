//! Test whether a pair shows one board in one pose in both images, and diagnosis of the pairs that fail it.
//!
//! The test is a likelihood ratio. Each image alone determines a pose of the board; both images together, with the rig,
//! determine one pose that must explain both. For a consistent pair the increase in chi squared (the rise) has six
//! degrees of freedom, independently of the residuals. Large residuals alone therefore never exclude a pair, and there
//! is no limit on them. If the rise is larger in all pairs (a lens that the model does not describe exactly), it is
//! compared with the usual rise of the set.

use super::Pair;
use super::bundle::{Noise, PoseFit, fit_pose};
use super::initial::pose_from_view;
use super::parameters::State;
use crate::calibrate::target::{Seen, Target};
use graspd_rt::geom::{Pose, View};

/// Maximum rise of chi squared per degree of freedom of a consistent pair, as a multiple of the usual rise. With normal
/// noise fewer than 1 in 10^20 consistent pairs reach it; a board of 54 points that moves by three times their noise
/// between the images reaches 40. The margin covers differences between the images of a real set: the usual rise is a
/// median, and single pairs are several times above it.
pub const MAX_RISE_RATIO: f64 = 20.0;
/// Median of chi squared with six degrees of freedom, per degree of freedom.
const MEDIAN_CHI2_6: f64 = 0.891;
/// Maximum chi squared per degree of freedom of one image alone, as a multiple of the usual value. Above it the points
/// are not on a flat board of the given size.
const MAX_ALONE_RATIO: f64 = 12.0;
/// Maximum width of the edges as a multiple of the usual width. Above it the image is blurred by motion or defocus.
const MAX_BLUR_RATIO: f64 = 2.5;
/// Minimum edge width of a blurred image, pixels.
const MIN_BLUR_PX: f64 = 1.5;
/// Maximum shift of a board's labels that is tested, squares.
const MAX_SHIFT_SQUARES: i64 = 2;

/// An excluded pair.
#[derive(Clone, Debug, PartialEq)]
pub struct LeftOut {
    /// Name of the pair.
    pub name: String,
    /// Identifier of the reason: "moved", "shifted", "mirrored", "swapped", "other-pair", "blurred", "not-a-board".
    pub kind: &'static str,
    /// Message with the reason.
    pub reason: String,
}

/// Test of one pair under a calibration.
#[derive(Clone, Debug)]
pub struct Test {
    /// Rise of chi squared per degree of freedom.
    pub rise: f64,
    /// Chi squared per degree of freedom of each image alone.
    pub alone: [f64; 2],
    /// The board's pose in the left frame from the left image, from the right image, from both.
    pub poses: [Pose; 3],
}

/// Tests a pair; `None` if no pose can be estimated.
pub fn test(target: &Target, state: &State, noise: &Noise, pair: &Pair) -> Option<Test> {
    let only = |v: usize| {
        let mut p = pair.clone();
        if let Some(other) = p.seen.get_mut(1 - v) {
            other.clear();
        }
        p
    };
    let rig = &state.rig;
    let fits: Vec<PoseFit> = View::BOTH
        .iter()
        .map(|v| {
            let k = v.index();
            let start = pose_from_view(target, rig.camera(*v), &pair.seen[k])?;
            let start = rig.view_from_left(*v).inverse() * start;
            fit_pose(target, state, noise, &only(k), &start)
        })
        .collect::<Option<_>>()?;
    let both = fits
        .iter()
        .filter_map(|f| fit_pose(target, state, noise, pair, &f.pose))
        .min_by(|a, b| a.chi2.total_cmp(&b.chi2));
    let alone = [0, 1].map(|k| fits[k].chi2 / (2.0 * pair.seen[k].len() as f64 - 6.0).max(1.0));
    let separate: f64 = fits.iter().map(|f| f.chi2).sum();
    // There is no common pose if one image places the board behind the other camera.
    let (rise, pose) = both.map_or((f64::MAX, fits[0].pose), |b| ((b.chi2 - separate) / 6.0, b.pose));
    Some(Test { rise, alone, poses: [fits[0].pose, fits[1].pose, pose] })
}

/// The usual rise; 1 if the noise agrees with the residuals.
pub fn usual_rise(tests: &[Test]) -> f64 {
    (median(tests.iter().map(|t| t.rise)) / MEDIAN_CHI2_6).max(1.0)
}

/// The usual chi squared per degree of freedom of an image alone.
pub fn usual_alone(tests: &[Test]) -> f64 {
    median(tests.iter().flat_map(|t| t.alone)).max(1e-3)
}

pub(super) fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut v: Vec<f64> = values.collect();
    v.sort_by(f64::total_cmp);
    v.get(v.len() / 2).copied().unwrap_or(1.0)
}

/// For each pair, the exclusion if it is blurred compared with the rest of the set.
pub fn blurred(pairs: &[Pair]) -> Vec<Option<LeftOut>> {
    let usual = [0, 1].map(|v| median(pairs.iter().map(|p| p.blur_px[v])));
    pairs
        .iter()
        .map(|p| {
            (0..2).find(|v| p.blur_px[*v] > MIN_BLUR_PX && p.blur_px[*v] > MAX_BLUR_RATIO * usual[*v]).map(|v| LeftOut {
                name: p.name.clone(),
                kind: "blurred",
                reason: format!(
                    "the {} image is blurred: its edges are {:.1} px wide, the median of the set is {:.1} px; hold the target still, or shorten the exposure",
                    side(v),
                    p.blur_px[v],
                    usual[v]
                ),
            })
        })
        .collect()
}

fn side(v: usize) -> &'static str {
    if v == 0 { "left" } else { "right" }
}

/// A calibration and the usual values of the set, against which pairs are tested.
pub struct PairCriteria<'a> {
    /// The target.
    pub target: &'a Target,
    /// The calibration.
    pub state: &'a State,
    /// The noise.
    pub noise: Noise,
    /// [`usual_rise`].
    pub usual: f64,
    /// [`usual_alone`].
    pub usual_alone: f64,
}

impl PairCriteria<'_> {
    /// Whether a pair is consistent.
    pub fn consistent(&self, t: &Test) -> bool {
        t.rise < MAX_RISE_RATIO * self.usual && self.not_a_board(t).is_none()
    }

    /// The view whose points are not on a flat board of the target's size.
    fn not_a_board(&self, t: &Test) -> Option<usize> {
        (0..2).find(|v| !(t.alone[*v] < MAX_ALONE_RATIO * self.usual_alone.max(1.0)))
    }

    fn explains(&self, pair: &Pair) -> bool {
        test(self.target, self.state, &self.noise, pair).is_some_and(|t| self.consistent(&t))
    }

    /// The pair with its right labels rotated by a symmetry of the board, if that makes the pair consistent. Such a
    /// pair is ambiguous, not faulty.
    pub fn relabelled(&self, pair: &Pair) -> Option<Pair> {
        let mut rotations = self.target.rotations().into_iter().skip(1);
        rotations.find_map(|map| {
            let mut p = pair.clone();
            for s in &mut p.seen[1] {
                s.index = *map.get(s.index)?;
            }
            p.seen[1].sort_by_key(|s| s.index);
            self.explains(&p).then_some(p)
        })
    }

    /// Diagnoses an inconsistent pair. `all` are the pairs of the set, searched for the left image that its right image
    /// belongs to.
    pub fn reason(&self, pair: &Pair, t: Option<&Test>, all: &[Pair]) -> LeftOut {
        let out = |kind: &'static str, reason: String| LeftOut { name: pair.name.clone(), kind, reason };
        if let Some(other) = all.iter().find(|o| o.name != pair.name && self.explains(&with_right(pair, o))) {
            return out(
                "other-pair",
                format!(
                    "its right image fits {}: the images are not paired in the order in which they were taken",
                    other.name
                ),
            );
        }
        if self.explains(&swapped(pair)) {
            return out("swapped", "its left and right images are swapped".to_owned());
        }
        for (views, text) in [
            ([true, false], "the left image is"),
            ([false, true], "the right image is"),
            ([true, true], "both images are"),
        ] {
            if self.explains(&mirrored(self.target, self.state, pair, views)) {
                return out("mirrored", format!("{text} mirrored; save images as the camera delivers them"));
            }
        }
        if let Some((c, r)) = self.shift(pair) {
            return out(
                "shifted",
                format!(
                    "the right image fits if its labels are shifted by {c} columns and {r} rows: the board moved by an integer number of squares between the two images, or another part of the board was detected"
                ),
            );
        }
        let Some(t) = t else {
            return out("not-a-board", "no pose of the board explains the points".to_owned());
        };
        if let Some(v) = self.not_a_board(t) {
            return out(
                "not-a-board",
                format!(
                    "the points of the {} image are not on a flat board of this size: the image shows another target, the grid is wrong, or the board is bent",
                    side(v)
                ),
            );
        }
        let motion = t.poses[1] * t.poses[0].inverse();
        let size = self.target.size() * 0.5;
        let centre = t.poses[0] * nalgebra::Point3::new(size.x, size.y, 0.0);
        let moved = (motion * centre - centre).norm() * 1e3;
        out(
            "moved",
            format!(
                "the images were not taken at the same time: the board moved by {moved:.1} mm and rotated by {:.2} degrees between them; hold the target still, or trigger both cameras together",
                motion.rotation.angle().to_degrees()
            ),
        )
    }

    /// Columns and rows by which the right labels are shifted.
    fn shift(&self, pair: &Pair) -> Option<(i64, i64)> {
        let (n, m) = (self.target.cols as i64, self.target.rows as i64);
        let shifts = (-MAX_SHIFT_SQUARES..=MAX_SHIFT_SQUARES)
            .flat_map(|c| (-MAX_SHIFT_SQUARES..=MAX_SHIFT_SQUARES).map(move |r| (c, r)))
            .filter(|s| *s != (0, 0));
        shifts.into_iter().find(|&(dc, dr)| {
            let mut p = pair.clone();
            p.seen[1] = pair.seen[1]
                .iter()
                .filter_map(|s| {
                    let (c, r) = (s.index as i64 % n + dc, s.index as i64 / n + dr);
                    let inside = (0..n).contains(&c) && (0..m).contains(&r);
                    inside.then(|| Seen { index: (r * n + c) as usize, ..*s })
                })
                .collect();
            p.seen[1].len() >= 8 && self.explains(&p)
        })
    }
}

fn with_right(pair: &Pair, other: &Pair) -> Pair {
    Pair { seen: [pair.seen[0].clone(), other.seen[1].clone()], ..pair.clone() }
}

fn swapped(pair: &Pair) -> Pair {
    Pair { seen: [pair.seen[1].clone(), pair.seen[0].clone()], ..pair.clone() }
}

/// The pair with the images of `views` mirrored.
pub(super) fn mirrored(target: &Target, state: &State, pair: &Pair, views: [bool; 2]) -> Pair {
    let mut out = pair.clone();
    for v in View::BOTH {
        if !views[v.index()] {
            continue;
        }
        let width = f64::from(state.rig.camera(v).width);
        for s in &mut out.seen[v.index()] {
            s.at.x = width - 1.0 - s.at.x;
            s.covariance[(0, 1)] = -s.covariance[(0, 1)];
            s.covariance[(1, 0)] = -s.covariance[(1, 0)];
            let (c, r) = (s.index % target.cols, s.index / target.cols);
            s.index = target.index(target.cols - 1 - c, r);
        }
        out.seen[v.index()].sort_by_key(|s| s.index);
    }
    out
}
