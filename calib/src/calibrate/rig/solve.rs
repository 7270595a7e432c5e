//! The estimate: a fit of each camera alone, consensus, then joint fit and exclusion of inconsistent pairs, repeated
//! until the set of pairs does not change.

use super::bundle::{Fit, Problem, fit};
use super::consensus::{Consensus, MAX_MEDIAN_DISAGREEMENT_PX, consensus};
use super::initial::single_camera;
use super::pairs::{LeftOut, PairCriteria, Test, blurred, mirrored, test, usual_alone, usual_rise};
use super::parameters::{BEND, BENDING, SHARED, State};
use super::{CalibrateError, MIN_PAIRS, Pair};
use crate::calibrate::target::Target;
use graspd_rt::geom::{Pose, Rig};

/// Maximum number of rounds in which pairs are excluded or readmitted.
const MAX_ROUNDS: usize = 30;

/// Image sizes and lens model.
#[derive(Clone, Copy, Debug)]
pub struct Lens {
    /// Image sizes, left and right.
    pub sizes: [(u32, u32); 2],
    /// Whether k4, k5, k6 are estimated.
    pub rational: bool,
}

/// Result of the estimate.
#[derive(Clone, Debug)]
pub struct Solved {
    /// Fit to the pairs used.
    pub fit: Fit,
    /// The pairs used, with their final labels.
    pub used: Vec<Pair>,
    /// Tests of the pairs used.
    pub tests: Vec<Test>,
    /// The excluded pairs, with the reason.
    pub left_out: Vec<LeftOut>,
}

/// Whether each shared parameter is estimated.
pub(super) fn free(rational: bool) -> [bool; SHARED] {
    let mut free = [true; SHARED];
    for camera in 0..2 {
        free[camera * 12 + 9..camera * 12 + 12].fill(rational);
    }
    free
}

/// Solves a set of pairs.
///
/// # Errors
/// Too few pairs, no common rig, or a fit that fails.
pub fn solve(target: &Target, mut pairs: Vec<Pair>, lens: &Lens) -> Result<Solved, CalibrateError> {
    let mut left_out = Vec::new();
    let blur = blurred(&pairs);
    pairs = pairs
        .into_iter()
        .zip(blur)
        .filter_map(|(p, b)| match b {
            Some(b) => {
                left_out.push(b);
                None
            }
            None => Some(p),
        })
        .collect();
    enough(pairs.len())?;
    align(target, &mut pairs);
    let (state, mut used) = start(target, &pairs, lens)?;
    let free = free(lens.rational);
    let mut poses = state.left_from_board.clone();
    let mut shared = State { left_from_board: Vec::new(), ..state };
    for round in 0.. {
        let fitted = joint(target, &pairs, &used, &shared, &poses, free)?;
        let at = State { left_from_board: Vec::new(), ..fitted.state.clone() };
        let tests: Vec<Option<Test>> = pairs.iter().map(|p| test(target, &at, &fitted.noise, p)).collect();
        let inside: Vec<Test> = tests.iter().zip(&used).filter(|(_, u)| **u).filter_map(|(t, _)| t.clone()).collect();
        let criteria = PairCriteria {
            target,
            state: &at,
            noise: fitted.noise,
            usual: usual_rise(&inside),
            usual_alone: usual_alone(&inside),
        };
        for (pose, t) in poses.iter_mut().zip(&tests) {
            if let Some(t) = t {
                *pose = t.poses[2];
            }
        }
        let changed = revise(&criteria, &mut pairs, &mut used, &tests);
        if !changed || round + 1 >= MAX_ROUNDS {
            for (k, p) in pairs.iter().enumerate() {
                if !used[k] {
                    left_out.push(criteria.reason(p, tests[k].as_ref(), &pairs));
                }
            }
            let kept = pairs.iter().zip(&used).filter(|(_, u)| **u).map(|(p, _)| p.clone()).collect();
            return Ok(Solved { fit: fitted, used: kept, tests: inside, left_out });
        }
        enough(used.iter().filter(|u| **u).count())?;
        shared = at;
    }
    Err(CalibrateError::NoFit)
}

fn enough(count: usize) -> Result<(), CalibrateError> {
    if count < MIN_PAIRS { Err(CalibrateError::TooFew { found: count }) } else { Ok(()) }
}

/// Excludes the worst inconsistent pair and readmits consistent ones; returns whether anything changed. Pairs are
/// excluded one at a time, since an inconsistent pair in the fit makes consistent pairs fail the test.
fn revise(criteria: &PairCriteria<'_>, pairs: &mut [Pair], used: &mut [bool], tests: &[Option<Test>]) -> bool {
    let mut changed = false;
    for k in 0..pairs.len() {
        if used[k] {
            continue;
        }
        if tests[k].as_ref().is_some_and(|t| criteria.consistent(t)) {
            used[k] = true;
            changed = true;
        } else if let Some(p) = criteria.relabelled(&pairs[k]) {
            pairs[k] = p;
            used[k] = true;
            changed = true;
        }
    }
    let badness = |t: &Option<Test>| {
        t.as_ref()
            .map_or(f64::MAX, |t| (t.rise / criteria.usual).max(t.alone[0].max(t.alone[1]) / criteria.usual_alone))
    };
    let worst = (0..pairs.len())
        .filter(|k| used[*k] && !tests[*k].as_ref().is_some_and(|t| criteria.consistent(t)))
        .max_by(|a, b| badness(&tests[*a]).total_cmp(&badness(&tests[*b])));
    if let Some(k) = worst {
        used[k] = false;
        changed = true;
    }
    changed
}

/// Joint fit of the pairs in use.
fn joint(
    target: &Target,
    pairs: &[Pair],
    used: &[bool],
    shared: &State,
    poses: &[Pose],
    free: [bool; SHARED],
) -> Result<Fit, CalibrateError> {
    let chosen: Vec<Pair> = pairs.iter().zip(used).filter(|(_, u)| **u).map(|(p, _)| p.clone()).collect();
    let poses = poses.iter().zip(used).filter(|(_, u)| **u).map(|(p, _)| *p).collect();
    let state = State { left_from_board: poses, ..shared.clone() };
    fit(&Problem { target, pairs: &chosen, free }, state).ok_or(CalibrateError::NoFit)
}

/// Rotates the labels of the right views to the orientation of the left views, for boards with a rotational symmetry.
pub(super) fn align(target: &Target, pairs: &mut [Pair]) {
    let rotations = target.rotations();
    for p in pairs {
        let [left, right] = &mut p.seen;
        let score = |map: &[usize]| -> f64 {
            let at = |k: usize| left.binary_search_by_key(&k, |s| s.index).ok().and_then(|i| left.get(i)).map(|s| s.at);
            let both: Vec<_> = right.iter().filter_map(|s| Some((at(*map.get(s.index)?)?, s.at))).collect();
            let n = both.len().max(1) as f64;
            let (a, b) = both
                .iter()
                .fold((nalgebra::Vector2::zeros(), nalgebra::Vector2::zeros()), |m, (a, b)| (m.0 + a / n, m.1 + b / n));
            both.iter().map(|(x, y)| (x - a).dot(&(y - b))).sum()
        };
        let best = rotations.iter().max_by(|x, y| score(x).total_cmp(&score(y)));
        if let Some(map) = best {
            for s in right.iter_mut() {
                s.index = map.get(s.index).copied().unwrap_or(s.index);
            }
            right.sort_by_key(|s| s.index);
        }
    }
}

/// Start values: each camera alone, then the consensus of the pairs.
fn start(target: &Target, pairs: &[Pair], lens: &Lens) -> Result<(State, Vec<bool>), CalibrateError> {
    let (left, right) = cameras(target, pairs, lens)?;
    let agreed = |pairs: &[Pair], right: &Fit| {
        consensus(target, &right.state.rig.left, pairs, &left.state.left_from_board, &right.state.left_from_board)
    };
    let found = agreed(pairs, &right).ok_or(CalibrateError::NoFit)?;
    if !(found.median_px < MAX_MEDIAN_DISAGREEMENT_PX) {
        return Err(CalibrateError::NoCommonRig {
            median_px: found.median_px,
            guess: guess(target, pairs, lens, &left, &right),
        });
    }
    let Consensus { right_from_left, agree, .. } = found;
    let rig = Rig { left: left.state.rig.left, right: right.state.rig.left, right_from_left };
    let state = State { rig, bend: [0.0; BEND], left_from_board: left.state.left_from_board };
    enough(agree.iter().filter(|a| **a).count())?;
    Ok((state, agree))
}

/// Fits each camera alone; the views of the right camera are passed as left views.
fn cameras(target: &Target, pairs: &[Pair], lens: &Lens) -> Result<(Fit, Fit), CalibrateError> {
    let alone = |v: usize| {
        let views: Vec<Pair> =
            pairs.iter().map(|p| Pair { seen: [p.seen[v].clone(), Vec::new()], ..p.clone() }).collect();
        single_camera(target, &views, lens.sizes[v], lens.rational)
    };
    Ok((
        alone(0).ok_or(CalibrateError::Camera { side: "left" })?,
        alone(1).ok_or(CalibrateError::Camera { side: "right" })?,
    ))
}

/// Searches for a change of the input under which the pairs agree: a different order of the right images, or mirrored
/// images.
fn guess(target: &Target, pairs: &[Pair], lens: &Lens, left: &Fit, right: &Fit) -> Option<&'static str> {
    let n = pairs.len();
    let reorder = |f: &dyn Fn(usize) -> usize| -> f64 {
        let poses: Vec<Pose> = (0..n).map(|k| right.state.left_from_board[f(k)]).collect();
        let moved: Vec<Pair> = (0..n)
            .map(|k| Pair { seen: [pairs[k].seen[0].clone(), pairs[f(k)].seen[1].clone()], ..pairs[k].clone() })
            .collect();
        consensus(target, &right.state.rig.left, &moved, &left.state.left_from_board, &poses)
            .map_or(f64::MAX, |c| c.median_px)
    };
    let orders: [(&'static str, &dyn Fn(usize) -> usize); 3] = [
        (
            "they agree if each right image is paired with the next left image: one camera has an extra or a missing image",
            &|k| (k + n - 1) % n,
        ),
        (
            "they agree if each right image is paired with the previous left image: one camera has an extra or a missing image",
            &|k| (k + 1) % n,
        ),
        (
            "they agree if the right images are in the reverse order: name the files so that left and right sort in the same order",
            &|k| n - 1 - k,
        ),
    ];
    if let Some((text, _)) = orders.iter().find(|(_, f)| reorder(f) < MAX_MEDIAN_DISAGREEMENT_PX) {
        return Some(text);
    }
    let rig = Rig { left: left.state.rig.left, right: right.state.rig.left, right_from_left: Pose::identity() };
    let state = State { rig, bend: [0.0; BEND], left_from_board: Vec::new() };
    for (views, text) in [
        ([false, true], "they agree if the right images are mirrored: save images as the camera delivers them"),
        ([true, false], "they agree if the left images are mirrored: save images as the camera delivers them"),
    ] {
        let mut flipped: Vec<Pair> = pairs.iter().map(|p| mirrored(target, &state, p, views)).collect();
        align(target, &mut flipped);
        if let Ok((l, r)) = cameras(target, &flipped, lens)
            && consensus(target, &r.state.rig.left, &flipped, &l.state.left_from_board, &r.state.left_from_board)
                .is_some_and(|c| c.median_px < MAX_MEDIAN_DISAGREEMENT_PX)
        {
            return Some(text);
        }
    }
    None
}

/// Bending of the board: half of its depth range, metres.
pub fn bending_m(target: &Target, state: &State) -> f64 {
    let z = |k: usize| state.board_point(target, k).z;
    let all = (0..target.count()).map(z);
    0.5 * (all.clone().fold(f64::MIN, f64::max) - all.fold(f64::MAX, f64::min))
}

/// Standard deviation of the bending, metres.
pub fn bending_sigma_m(fit: &Fit) -> f64 {
    (0..BEND).map(|k| fit.covariance[(BENDING + k, BENDING + k)].max(0.0)).sum::<f64>().sqrt()
}
