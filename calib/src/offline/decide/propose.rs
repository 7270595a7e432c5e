//! Rims proposed without a click: ellipses found in each view, paired by the two-view condition, ranked.

use crate::offline::contour::quick_fit::Walk;
use crate::offline::contour::select::Candidate;
use crate::offline::contour::{Contour, ViewEdges, alike};
use crate::offline::decide::reconstruct::reconstruct;
use crate::offline::rim::model::{Options, Reconstruction, RimChoice};
use crate::offline::types::projection::Projection;
use crate::offline::types::{Ellipse2, Outline};

/// A rim proposed to the operator.
#[derive(Clone, Debug)]
pub struct Proposal {
    /// Its contours, left and right.
    pub contours: [Contour; 2],
    /// The plane rim that they are images of.
    pub reconstruction: Reconstruction,
    /// Rank of the proposal: complete, large and consistent rims first.
    pub score: f64,
}

impl Proposal {
    /// Its contours as candidates for planning.
    pub fn candidates(&self) -> [Vec<Candidate>; 2] {
        self.contours.clone().map(|contour| vec![Candidate { contour, cost: 0.0 }])
    }
}

/// Largest number of seeds per view: arcs that turn, longest first.
const MAX_SEEDS: usize = 120;
/// Smallest fraction of an ellipse that has to carry edges.
const MIN_COVERAGE: f64 = 0.5;
/// The same before a trial ellipse is refitted to its edges: smaller, since refitting collects more.
const MIN_TRIAL_COVERAGE: f64 = 0.4;
/// Largest number of ellipses per view.
const MAX_ELLIPSES: usize = 40;

/// The clearest ellipses of one view, best first. `watch` receives the completed fraction.
pub fn ellipses(edges: &ViewEdges<'_>, mut watch: impl FnMut(f64)) -> Vec<Contour> {
    let mut seeds: Vec<_> = edges.arcs.arcs.iter().filter(|a| a.turn.abs() > 0.35 && a.edges.len() >= 16).collect();
    seeds.sort_by(|a, b| (b.turn.abs() * b.edges.len() as f64).total_cmp(&(a.turn.abs() * a.edges.len() as f64)));
    seeds.truncate(MAX_SEEDS);
    let mut out: Vec<Contour> = Vec::new();
    for (k, arc) in seeds.iter().enumerate() {
        watch(k as f64 / seeds.len() as f64);
        let Some(seed) = arc.edges.get(arc.edges.len() / 2) else { continue };
        let Some(at) = edges.arcs.ideal.get(*seed as usize) else { continue };
        // An arc on an ellipse already found adds nothing.
        let known = out.iter().any(|c| {
            let (d, n, _) = Walk::new(&c.ellipse).measure(at.at);
            let sign = if c.bright_inside { -1.0 } else { 1.0 };
            d.abs() < 1.5 && at.towards_bright.dot(&n) * sign > 0.9
        });
        if known {
            continue;
        }
        let is_known = |out: &[Contour], e: &Ellipse2, bright_inside: bool| {
            out.iter().any(|o| alike(&o.ellipse, e) && o.bright_inside == bright_inside)
        };
        // Nor does an arc that leads to such an ellipse: most of the time would be spent on finding it again.
        let trial = edges.promising(*seed as usize, MIN_TRIAL_COVERAGE).filter(|t| t.coverage >= MIN_COVERAGE);
        let Some(trial) = trial.filter(|t| !is_known(&out, &t.ellipse, t.bright_inside)) else { continue };
        let contour =
            edges.contour(&trial).filter(|c| c.coverage > MIN_COVERAGE && c.rms_px < 0.6 && c.points.len() >= 20);
        if let Some(c) = contour.filter(|c| !is_known(&out, &c.ellipse, c.bright_inside)) {
            out.push(c);
        }
    }
    out.sort_by(|a, b| quality(b).total_cmp(&quality(a)));
    out.truncate(MAX_ELLIPSES);
    out
}

fn quality(c: &Contour) -> f64 {
    c.coverage * c.coverage * (c.points.len() as f64).sqrt() / (0.15 + c.rms_px)
}

/// Pairs the ellipses of both views that reconstruct to a rim, best first, at most `most`. `watch` receives the
/// completed fraction.
pub fn propose(
    views: &[ViewEdges<'_>; 2],
    p: [&Projection; 2],
    options: &Options,
    most: usize,
    watch: &mut dyn FnMut(f64),
) -> Vec<Proposal> {
    let options =
        Options { rim: if options.rim == RimChoice::RoundBar { RimChoice::Edge } else { options.rim }, ..*options };
    let left = ellipses(&views[0], |part| watch(0.5 * part));
    let right = ellipses(&views[1], |part| watch(0.5 + 0.5 * part));
    let mut found: Vec<(f64, usize, usize, Reconstruction)> = Vec::new();
    for (i, l) in left.iter().enumerate() {
        let a = l.edge_points(Outline::Outer);
        for (j, r) in right.iter().enumerate() {
            let ratio = l.ellipse.a / r.ellipse.a;
            if l.bright_inside != r.bright_inside || !(0.5..2.0).contains(&ratio) {
                continue;
            }
            if let Ok(rec) = reconstruct(&a, p[0], &r.edge_points(Outline::Outer), p[1], &options) {
                let gap = rec.report.gap_px.iter().filter(|g| g.is_finite()).map(|g| g.abs()).fold(0.0, f64::max);
                found.push(((quality(l) * quality(r)).sqrt() / (0.3 + gap), i, j, rec));
            }
        }
    }
    // Best pair first; each ellipse is the image of one rim only.
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    let (mut used_left, mut used_right) = (vec![false; left.len()], vec![false; right.len()]);
    let mut out = Vec::new();
    for (score, i, j, reconstruction) in found {
        let (Some(ul), Some(ur)) = (used_left.get_mut(i), used_right.get_mut(j)) else { continue };
        if *ul || *ur || out.len() >= most {
            continue;
        }
        (*ul, *ur) = (true, true);
        if let (Some(l), Some(r)) = (left.get(i), right.get(j)) {
            out.push(Proposal { contours: [l.clone(), r.clone()], reconstruction, score });
        }
    }
    out
}
