//! Trial ellipses through a seed edge, and their support by the edges of the image.

use crate::offline::contour::directions::{MIN_COSINE, REACH_PX};
use crate::offline::contour::one_ellipse::{MIN_COVERAGE, alike};
use crate::offline::contour::quick_fit::{Sums, Walk};
use crate::offline::contour::view_edges::ViewEdges;
use crate::offline::edges::arcs::IdealEdge;
use crate::offline::types::Ellipse2;

/// Points of a quick score, per quarter turn.
const QUICK_POINTS: usize = 8;
/// Largest amount by which a quick score may underestimate the covered fraction. One standard deviation over its 32
/// points is 0.09, but it also counts every edge within reach as a match.
const MAX_QUICK_ERROR: f64 = 0.05;
/// Trials of a seed that are scored in full after a quick score of all. With 200 the proposals equal those of scoring
/// all; with 24 the best one of the street scene is missed in one view.
const MAX_FULL_SCORES: usize = 200;

/// A trial ellipse and its support.
#[derive(Clone, Debug)]
pub(in crate::offline) struct Trial {
    pub(in crate::offline) ellipse: Ellipse2,
    pub(in crate::offline) bright_inside: bool,
    pub(in crate::offline) coverage: f64,
    pub(in crate::offline) score: f64,
    hits: Vec<u32>,
}

/// The best trials so far, best first.
struct Best {
    found: Vec<Trial>,
    most: usize,
}

impl Best {
    /// Score that a trial has to exceed to be added.
    fn floor(&self) -> f64 {
        match self.found.last() {
            Some(last) if self.found.len() >= self.most => last.score,
            _ => f64::NEG_INFINITY,
        }
    }

    fn offer(&mut self, t: Option<Trial>) {
        let floor = self.floor();
        if let Some(t) = t.filter(|t| t.score > floor) {
            self.found.push(t);
            self.found.sort_by(|a, b| b.score.total_cmp(&a.score));
            self.found.truncate(self.most);
        }
    }
}

/// The ellipse of some sums and whether its inside is brighter, if it passes the seed in the seed's direction.
fn passing(sums: &Sums, s: &IdealEdge) -> Option<(Ellipse2, bool)> {
    let e = sums.ellipse()?;
    let (d, n, _) = Walk::new(&e).measure(s.at);
    let along = s.towards_bright.dot(&n);
    (d.abs() <= 2.5 && along.abs() >= 0.9).then_some((e, along < 0.0))
}

impl ViewEdges<'_> {
    /// Trial ellipses through a seed edge, best first, at most `keep` and no two alike.
    pub(in crate::offline) fn trials(&self, seed: usize, keep: usize) -> Vec<Trial> {
        let mut best = Best { found: Vec::new(), most: 4 * keep };
        self.combinations(seed, |s, sums| {
            if let Some((e, bright_inside)) = passing(sums, s) {
                best.offer(self.score(&e, bright_inside, 3.0, best.floor()));
            }
        });
        self.refitted(seed, best.found, keep)
    }

    /// The best trial ellipse through a seed edge, out of those with the highest quick scores. All carry edges on at
    /// least a fraction `least` of their outline.
    ///
    /// For seeds that the operator did not choose: there are many, most of them on no ellipse, and scoring every
    /// combination in full would take seconds.
    pub(in crate::offline) fn promising(&self, seed: usize, least: f64) -> Option<Trial> {
        let mut quick: Vec<(f64, Ellipse2, bool)> = Vec::new();
        self.combinations(seed, |s, sums| {
            if let Some((e, bright_inside)) = passing(sums, s) {
                let part = self.quick_score(&e, bright_inside);
                if part >= least {
                    let at_most = part + MAX_QUICK_ERROR;
                    quick.push((at_most * at_most * Walk::new(&e).perimeter().sqrt(), e, bright_inside));
                }
            }
        });
        quick.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut best = Best { found: Vec::new(), most: 4 };
        for (at_most, e, bright_inside) in quick.iter().take(MAX_FULL_SCORES) {
            if *at_most <= best.floor() {
                break;
            }
            let floor = least * least * Walk::new(e).perimeter().sqrt();
            best.offer(self.score(e, *bright_inside, 3.0, best.floor().max(floor)));
        }
        self.refitted(seed, best.found, 1).into_iter().next()
    }

    /// Calls `take` with the seed and the sums of its neighbourhood, alone and with every arc that could join it.
    fn combinations(&self, seed: usize, mut take: impl FnMut(&IdealEdge, &Sums)) {
        let (Some(s), Some(own)) = (self.arcs.ideal.get(seed), self.arcs.of(seed)) else { return };
        let Some(arc) = self.arcs.arcs.get(own) else { return };
        if !s.at.x.is_finite() {
            return;
        }
        let position = arc.edges.iter().position(|k| *k as usize == seed).unwrap_or(0);
        let blank = Sums::new(s.at, 100.0);
        let piece = |half: usize| {
            let mut sums = blank;
            let (from, to) = (position.saturating_sub(half), (position + half + 1).min(arc.edges.len()));
            let step = ((to - from) / 40).max(1);
            for k in arc.edges.get(from..to).unwrap_or(&[]).iter().step_by(step) {
                if let Some(e) = self.arcs.ideal.get(*k as usize) {
                    sums.add(e.at, 1.0);
                }
            }
            sums
        };
        for half in [25, 50, 100, 200, 5000] {
            take(&s, &piece(half));
            if half > arc.edges.len() {
                break;
            }
        }
        let near = piece(60);
        for k in self.longest.iter().take(1500) {
            if *k as usize == own {
                continue;
            }
            let Some(samples) = self.samples.get(*k as usize) else { continue };
            if !self.could_join(&s, samples) {
                continue;
            }
            let mut sums = blank;
            for e in samples.iter().filter_map(|k| self.arcs.ideal.get(*k as usize)) {
                sums.add(e.at, 1.0);
            }
            take(&s, &near.plus(&sums));
        }
    }

    /// The best trials of a seed after refitting, best first, at most `keep` and no two alike.
    fn refitted(&self, seed: usize, best: Vec<Trial>, keep: usize) -> Vec<Trial> {
        let Some(s) = self.arcs.ideal.get(seed) else { return Vec::new() };
        let mut out: Vec<Trial> = Vec::new();
        for t in best {
            let t = self.refit(t, &s);
            if t.coverage >= 0.8 * MIN_COVERAGE && !out.iter().any(|o| alike(&o.ellipse, &t.ellipse)) {
                out.push(t);
            }
        }
        out.sort_by(|a, b| b.score.total_cmp(&a.score));
        out.truncate(keep);
        out
    }

    /// Whether an arc could lie on one convex curve with the seed, with the same side brighter.
    fn could_join(&self, s: &IdealEdge, samples: &[u32]) -> bool {
        let (mut inside, mut outside) = (0, 0);
        for e in [samples.first(), samples.get(samples.len() / 2), samples.last()].into_iter().flatten() {
            let Some(e) = self.arcs.ideal.get(*e as usize) else { return false };
            let d = e.at - s.at;
            let (a, b) = (s.towards_bright.dot(&d), -e.towards_bright.dot(&d));
            let slack = 2.0 + 0.03 * d.norm();
            if a > -slack && b > -slack {
                inside += 1;
            }
            if a < slack && b < slack {
                outside += 1;
            }
            // One sample of three that lies on neither side rejects the arc.
            if inside + outside == 0 {
                return false;
            }
        }
        inside == 3 || outside == 3
    }

    /// Fraction of an ellipse that may have edges, from a few points at equal parameters; 0 for an ellipse that is not
    /// a plausible contour.
    fn quick_score(&self, e: &Ellipse2, bright_inside: bool) -> f64 {
        if !self.is_plausible(e) {
            return 0.0;
        }
        let sign = if bright_inside { -1.0 } else { 1.0 };
        let (mut seen, mut likely) = (0usize, 0usize);
        self.turns.round(Walk::new(e), QUICK_POINTS, |p, n| {
            let raw = self.lens.raw(p);
            if self.image.contains(raw, 6.0) {
                seen += 1;
                likely += usize::from(self.may_have_edge(raw, n * sign));
            }
        });
        likely as f64 / seen.max(1) as f64
    }

    fn is_plausible(&self, e: &Ellipse2) -> bool {
        let most = 1.5 * self.map.width().max(self.map.height()) as f64;
        e.b > 4.0 && e.a < most && e.b > 0.04 * e.a
    }

    /// Scores an ellipse by the edges along it; `None` as soon as its score cannot exceed `floor` any more.
    fn score(&self, e: &Ellipse2, bright_inside: bool, tolerance: f64, floor: f64) -> Option<Trial> {
        if !self.is_plausible(e) {
            return None;
        }
        let w = Walk::new(e);
        let sign = if bright_inside { -1.0 } else { 1.0 };
        let root = w.perimeter().sqrt();
        // The score of full coverage.
        if root <= floor {
            return None;
        }
        let score_of = |hits: usize, seen: usize| {
            let coverage = hits as f64 / seen.max(1) as f64;
            coverage * coverage * root
        };
        let points = w.points(3.0, &self.turns);
        // Points in the image that may have an edge. Most of a wrong trial's points have none, by the look-up alone.
        let (mut seen, mut likely) = (0usize, Vec::with_capacity(points.len()));
        for (i, (p, n)) in points.iter().enumerate() {
            let raw = self.lens.raw(*p);
            if !self.image.contains(raw, 6.0) {
                continue;
            }
            seen += 1;
            if self.may_have_edge(raw, n * sign) {
                likely.push((raw, *p, *n));
            } else {
                let more = points.len() - i - 1;
                if score_of(likely.len() + more, seen + more) <= floor {
                    return None;
                }
            }
        }
        if seen * 5 < points.len() * 2 {
            return None;
        }
        let mut hits = Vec::with_capacity(likely.len());
        for (i, (raw, p, n)) in likely.iter().enumerate() {
            let mut best = (tolerance, None);
            self.map.within(*raw, *raw, (tolerance.ceil() as i32).min(REACH_PX), |k, _, _| {
                let Some(i) = self.arcs.ideal.get(k) else { return };
                let d = i.at - p;
                let off = d.dot(n).abs();
                if off < best.0 && i.towards_bright.dot(n) * sign > MIN_COSINE && d.norm() < tolerance + 1.5 {
                    best = (off, Some(k as u32));
                }
            });
            match best.1 {
                Some(k) => hits.push(k),
                None if score_of(hits.len() + likely.len() - i - 1, seen) <= floor => return None,
                None => {}
            }
        }
        let coverage = hits.len() as f64 / seen.max(1) as f64;
        Some(Trial { ellipse: *e, bright_inside, coverage, score: score_of(hits.len(), seen), hits })
    }

    /// Refits a trial to its own edges until it stops changing. It has to keep passing the seed.
    fn refit(&self, start: Trial, s: &IdealEdge) -> Trial {
        let mut best = start;
        for k in 0..6 {
            let mut sums = Sums::new(best.ellipse.centre, best.ellipse.a);
            for e in best.hits.iter().filter_map(|k| self.arcs.ideal.get(*k as usize)) {
                sums.add(e.at, 1.0);
            }
            // The weight of the seed keeps the ellipse on the selected contour.
            sums.add(s.at, 0.1 * best.hits.len() as f64);
            let Some(e) = sums.ellipse() else { break };
            let tolerance = if k < 2 { 3.0 } else { 2.0 };
            let Some(t) = self.score(&e, best.bright_inside, tolerance, f64::NEG_INFINITY) else { break };
            let (d, n, _) = Walk::new(&t.ellipse).measure(s.at);
            if d.abs() > 2.0 || s.towards_bright.dot(&n).abs() < 0.9 {
                break;
            }
            let same = alike(&t.ellipse, &best.ellipse) && t.hits.len() == best.hits.len();
            best = t;
            if same {
                break;
            }
        }
        best
    }
}
