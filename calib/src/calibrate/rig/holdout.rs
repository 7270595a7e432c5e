//! Hold-out: scores each pair with a calibration computed without it.

use super::Pair;
use super::bundle::{Problem, fit, fit_pose};
use super::parameters::State;
use super::score::{Scores, score};
use super::solve::{Solved, free};
use crate::calibrate::target::Target;
use graspd_rt::geom::{Rig, View};

/// Number of groups of pairs; one group is held out at a time.
pub const FOLDS: usize = 4;

/// Results on the held-out pairs.
#[derive(Clone, Debug)]
pub struct Holdout {
    /// Scores pooled over all pairs, each held out once.
    pub scores: Scores,
    /// Scores of each pair, in the order of the pairs used.
    pub per_pair: Vec<Scores>,
    /// Reprojection error of each point with one board pose for both images, pixels.
    pub reprojection_px: Vec<f64>,
    /// The rig of each group's fit.
    pub rigs: Vec<Rig>,
}

/// Runs the hold-out; `None` if a fit fails.
pub fn holdout(target: &Target, solved: &Solved, rational: bool) -> Option<Holdout> {
    let n = solved.used.len();
    let mut per_pair = vec![Scores::default(); n];
    let mut reprojection_px = Vec::new();
    let mut rigs = Vec::new();
    for fold in 0..FOLDS {
        let kept: Vec<usize> = (0..n).filter(|k| k % FOLDS != fold).collect();
        let pairs: Vec<Pair> = kept.iter().map(|k| solved.used[*k].clone()).collect();
        let poses = kept.iter().map(|k| solved.fit.state.left_from_board[*k]).collect();
        let start = State { left_from_board: poses, ..solved.fit.state.clone() };
        let f = fit(&Problem { target, pairs: &pairs, free: free(rational) }, start)?;
        let bare = State { left_from_board: Vec::new(), ..f.state.clone() };
        for k in (0..n).filter(|k| k % FOLDS == fold) {
            let pair = &solved.used[k];
            per_pair[k] = score(&f.state.rig, target, pair);
            if let Some(p) = fit_pose(target, &bare, &f.noise, pair, &solved.fit.state.left_from_board[k]) {
                reprojection_px.extend(errors(target, &bare, pair, &p.pose));
            }
        }
        rigs.push(f.state.rig);
    }
    let mut scores = Scores::default();
    per_pair.iter().for_each(|s| scores.extend(s.clone()));
    Some(Holdout { scores, per_pair, reprojection_px, rigs })
}

fn errors(target: &Target, state: &State, pair: &Pair, pose: &graspd_rt::geom::Pose) -> Vec<f64> {
    View::BOTH
        .iter()
        .flat_map(|v| pair.seen[v.index()].iter().map(move |s| (v.index(), s)))
        .filter_map(|(v, s)| Some((s.at - super::parameters::project(state, target, pose, v, s.index)?.at).norm()))
        .collect()
}
