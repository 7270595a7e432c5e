//! Which pairs cannot be what they claim to be: one board, at one place, in both images; and why not.
//!
//! The test is a likelihood ratio. Each image alone gives a pose of the board; both together, with the rig, give one
//! pose that has to explain both. What chi squared rises by has six degrees of freedom where the pair is good, whatever
//! the residuals are: a pair that only fits badly is not left out, and no target for the residuals enters. Where all
//! pairs rise by more (a lens that the model does not quite describe), the usual rise is the measure.

use super::Pair;
use super::bundle::{Noise, PoseFit, fit_pose};
use super::initial::pose_from_view;
use super::parameters::State;
use crate::calibrate::target::{Seen, Target};
use graspd_rt::geom::{Pose, View};

/// Rise of chi squared a degree of freedom from which a pair is wrong, in usual rises. Of good pairs with normal noise
/// less than 1 in 10^20 reaches it; a board of 54 points moved by three times their noise between the images reaches
/// 40. The margin is for what differs between the images of a real set: the usual rise is a median, single pairs are
/// several times above it.
pub const WRONG: f64 = 20.0;
/// Median of chi squared with six degrees of freedom, a degree.
const MEDIAN_6: f64 = 0.891;
/// Chi squared a degree of freedom of one image alone, in the usual one, from which its points are no flat board of
/// that size.
const NOT_A_BOARD: f64 = 12.0;
/// Edges this many times as wide as usual are blurred by motion or focus.
const BLURRED: f64 = 2.5;
/// No edge is called blurred below this width, pixels.
const BLURRED_PX: f64 = 1.5;
/// Steps by which a board's labels may be shifted.
const SHIFTS: i64 = 2;

/// A pair that is left out.
#[derive(Clone, Debug, PartialEq)]
pub struct LeftOut {
    /// Which one.
    pub name: String,
    /// A word for machines: "moved", "shifted", "mirrored", "swapped", "other-pair", "blurred", "not-a-board".
    pub kind: &'static str,
    /// Why, for people.
    pub reason: String,
}

/// What one pair says against a calibration.
#[derive(Clone, Debug)]
pub struct Test {
    /// Rise of chi squared, a degree of freedom.
    pub rise: f64,
    /// Chi squared a degree of freedom of each image alone.
    pub alone: [f64; 2],
    /// The board's pose in the left frame from the left image, from the right image, from both.
    pub poses: [Pose; 3],
}

/// Tests a pair; `None` where no pose can be found at all.
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
    // A board that one image puts behind the other camera has no common pose.
    let (rise, pose) = both.map_or((f64::MAX, fits[0].pose), |b| ((b.chi2 - separate) / 6.0, b.pose));
    Some(Test { rise, alone, poses: [fits[0].pose, fits[1].pose, pose] })
}

/// The usual rise: 1 where the noise is what the residuals say.
pub fn usual_rise(tests: &[Test]) -> f64 {
    (median(tests.iter().map(|t| t.rise)) / MEDIAN_6).max(1.0)
}

/// The usual chi squared a degree of freedom of an image alone.
pub fn usual_alone(tests: &[Test]) -> f64 {
    median(tests.iter().flat_map(|t| t.alone)).max(1e-3)
}

pub(super) fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut v: Vec<f64> = values.collect();
    v.sort_by(f64::total_cmp);
    v.get(v.len() / 2).copied().unwrap_or(1.0)
}

/// Pairs that are blurred against the others of the set.
pub fn blurred(pairs: &[Pair]) -> Vec<Option<LeftOut>> {
    let usual = [0, 1].map(|v| median(pairs.iter().map(|p| p.blur_px[v])));
    pairs
        .iter()
        .map(|p| {
            (0..2).find(|v| p.blur_px[*v] > BLURRED_PX && p.blur_px[*v] > BLURRED * usual[*v]).map(|v| LeftOut {
                name: p.name.clone(),
                kind: "blurred",
                reason: format!(
                    "the {} image is blurred: its edges are {:.1} px wide, those of the others {:.1} px; hold the target still, or shorten the exposure",
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

/// What a set is held against: a calibration, and what is usual in it.
pub struct Judge<'a> {
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

impl Judge<'_> {
    /// Whether a pair is good.
    pub fn good(&self, t: &Test) -> bool {
        t.rise < WRONG * self.usual && self.is_board(t).is_none()
    }

    /// The image whose points are no flat board of the target's size.
    fn is_board(&self, t: &Test) -> Option<usize> {
        (0..2).find(|v| !(t.alone[*v] < NOT_A_BOARD * self.usual_alone.max(1.0)))
    }

    fn explains(&self, pair: &Pair) -> bool {
        test(self.target, self.state, &self.noise, pair).is_some_and(|t| self.good(&t))
    }

    /// The pair with its right labels turned as the board looks the same, where that makes it good: no fault, an
    /// ambiguity.
    pub fn turned(&self, pair: &Pair) -> Option<Pair> {
        let mut turns = self.target.turns().into_iter().skip(1);
        turns.find_map(|map| {
            let mut p = pair.clone();
            for s in &mut p.seen[1] {
                s.index = *map.get(s.index)?;
            }
            p.seen[1].sort_by_key(|s| s.index);
            self.explains(&p).then_some(p)
        })
    }

    /// Why a pair is wrong. `all` are the pairs of the set, to find a right image that belongs to another left one.
    pub fn reason(&self, pair: &Pair, t: Option<&Test>, all: &[Pair]) -> LeftOut {
        let out = |kind: &'static str, reason: String| LeftOut { name: pair.name.clone(), kind, reason };
        if let Some(other) = all.iter().find(|o| o.name != pair.name && self.explains(&with_right(pair, o))) {
            return out(
                "other-pair",
                format!(
                    "its right image belongs to {}: the images are paired in another order than they were taken",
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
                    "the right image fits with the board {c} columns and {r} rows beside: the board was moved by whole squares between the two images, or a part of another board was taken for it"
                ),
            );
        }
        let Some(t) = t else {
            return out("not-a-board", "no pose of the board explains its points".to_owned());
        };
        if let Some(v) = self.is_board(t) {
            return out(
                "not-a-board",
                format!(
                    "the points of the {} image do not lie on a flat board of this size: another target, a wrong grid, or a bent board",
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
                "not taken at the same time: between its two images the board moved by {moved:.1} mm and turned by {:.2} degrees; hold the target still, or trigger both cameras together",
                motion.rotation.angle().to_degrees()
            ),
        )
    }

    /// Whole squares by which the right labels are shifted.
    fn shift(&self, pair: &Pair) -> Option<(i64, i64)> {
        let (n, m) = (self.target.cols as i64, self.target.rows as i64);
        let shifts = (-SHIFTS..=SHIFTS).flat_map(|c| (-SHIFTS..=SHIFTS).map(move |r| (c, r))).filter(|s| *s != (0, 0));
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

/// The pair with images mirrored back.
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
