//! Trial ellipses through a seed edge, and how well the edges of the image support them.

use crate::offline::contour::directions::{ALONG, REACH};
use crate::offline::contour::one_ellipse::{LEAST_COVERAGE, alike};
use crate::offline::contour::quick_fit::{Sums, Walk};
use crate::offline::contour::view_edges::ViewEdges;
use crate::offline::edges::arcs::IdealEdge;
use crate::offline::types::Ellipse2;

/// Places of a glance at a trial ellipse, in quarters.
const GLANCES: usize = 8;
/// By how much a glance may put the part of an ellipse that carries edges too low: one standard deviation of its 32 places is 0.09, and it takes any edge
/// in reach for one that fits.
const MISJUDGED: f64 = 0.05;
/// Trials of a seed that are judged after a glance at all of them: with 200 the proposals are those of judging all, with 24 the street scene's best one
/// is missed in one view.
const JUDGED: usize = 200;

/// A trial ellipse and how well it is supported.
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
    /// What a trial has to exceed to get in.
    fn bar(&self) -> f64 {
        match self.found.last() {
            Some(last) if self.found.len() >= self.most => last.score,
            _ => f64::NEG_INFINITY,
        }
    }

    fn offer(&mut self, t: Option<Trial>) {
        let bar = self.bar();
        if let Some(t) = t.filter(|t| t.score > bar) {
            self.found.push(t);
            self.found.sort_by(|a, b| b.score.total_cmp(&a.score));
            self.found.truncate(self.most);
        }
    }
}

/// The ellipse of some sums and whether its inside is the brighter side, if it passes the seed in the seed's direction.
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
        self.joined(seed, |s, sums| {
            if let Some((e, bright_inside)) = passing(sums, s) {
                best.offer(self.judge(&e, bright_inside, 3.0, best.bar()));
            }
        });
        self.settled(seed, best.found, keep)
    }

    /// The best trial ellipse through a seed edge of those that promise most at a glance; all carry edges on a part of their outline from the start, `least`.
    ///
    /// Nobody pointed at the seed: there are many, most of them on nothing, and judging all that each could be joined to would take seconds.
    pub(in crate::offline) fn promising(&self, seed: usize, least: f64) -> Option<Trial> {
        let mut glanced: Vec<(f64, Ellipse2, bool)> = Vec::new();
        self.joined(seed, |s, sums| {
            if let Some((e, bright_inside)) = passing(sums, s) {
                let part = self.glance(&e, bright_inside);
                if part >= least {
                    let at_most = part + MISJUDGED;
                    glanced.push((at_most * at_most * Walk::new(&e).perimeter().sqrt(), e, bright_inside));
                }
            }
        });
        glanced.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut best = Best { found: Vec::new(), most: 4 };
        for (at_most, e, bright_inside) in glanced.iter().take(JUDGED) {
            if *at_most <= best.bar() {
                break;
            }
            let floor = least * least * Walk::new(e).perimeter().sqrt();
            best.offer(self.judge(e, *bright_inside, 3.0, best.bar().max(floor)));
        }
        self.settled(seed, best.found, 1).into_iter().next()
    }

    /// Gives a function the sums of a seed's neighbourhood, alone and with every arc that could join it, and the seed.
    fn joined(&self, seed: usize, mut take: impl FnMut(&IdealEdge, &Sums)) {
        let (Some(s), Some(own)) = (self.arcs.ideal.get(seed), self.arcs.of(seed)) else { return };
        let Some(arc) = self.arcs.arcs.get(own) else { return };
        if !s.at.x.is_finite() {
            return;
        }
        let place = arc.edges.iter().position(|k| *k as usize == seed).unwrap_or(0);
        let blank = Sums::new(s.at, 100.0);
        let piece = |half: usize| {
            let mut sums = blank;
            let (from, to) = (place.saturating_sub(half), (place + half + 1).min(arc.edges.len()));
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

    /// The best trials of a seed settled, best first, at most `keep` and no two alike.
    fn settled(&self, seed: usize, best: Vec<Trial>, keep: usize) -> Vec<Trial> {
        let Some(s) = self.arcs.ideal.get(seed) else { return Vec::new() };
        let mut out: Vec<Trial> = Vec::new();
        for t in best {
            let t = self.settle(t, &s);
            if t.coverage >= 0.8 * LEAST_COVERAGE && !out.iter().any(|o| alike(&o.ellipse, &t.ellipse)) {
                out.push(t);
            }
        }
        out.sort_by(|a, b| b.score.total_cmp(&a.score));
        out.truncate(keep);
        out
    }

    /// Whether an arc could lie on one convex curve with the seed, the same side brighter.
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
            // One sample of three that lies on neither side decides it.
            if inside + outside == 0 {
                return false;
            }
        }
        inside == 3 || outside == 3
    }

    /// Part of an ellipse that may have edges, judged from a few places at equal parameters; nothing for one that is no contour.
    fn glance(&self, e: &Ellipse2, bright_inside: bool) -> f64 {
        if !self.is_sound(e) {
            return 0.0;
        }
        let sign = if bright_inside { -1.0 } else { 1.0 };
        let (mut seen, mut likely) = (0usize, 0usize);
        self.turns.round(Walk::new(e), GLANCES, |p, n| {
            let raw = self.lens.raw(p);
            if self.image.contains(raw, 6.0) {
                seen += 1;
                likely += usize::from(self.may_have_edge(raw, n * sign));
            }
        });
        likely as f64 / seen.max(1) as f64
    }

    fn is_sound(&self, e: &Ellipse2) -> bool {
        let most = 1.5 * self.map.width().max(self.map.height()) as f64;
        e.b > 4.0 && e.a < most && e.b > 0.04 * e.a
    }

    /// Judges an ellipse by the edges along it; `None` as soon as its score cannot exceed the bar any more.
    fn judge(&self, e: &Ellipse2, bright_inside: bool, tolerance: f64, bar: f64) -> Option<Trial> {
        if !self.is_sound(e) {
            return None;
        }
        let w = Walk::new(e);
        let sign = if bright_inside { -1.0 } else { 1.0 };
        let root = w.perimeter().sqrt();
        // Complete, it would score its root.
        if root <= bar {
            return None;
        }
        let score = |hits: usize, seen: usize| {
            let coverage = hits as f64 / seen.max(1) as f64;
            coverage * coverage * root
        };
        let places = w.places(3.0, &self.turns);
        // Places in the image that may have an edge: most of a wrong trial's have none, and tell so at a glance.
        let (mut seen, mut likely) = (0usize, Vec::with_capacity(places.len()));
        for (i, (p, n)) in places.iter().enumerate() {
            let raw = self.lens.raw(*p);
            if !self.image.contains(raw, 6.0) {
                continue;
            }
            seen += 1;
            if self.may_have_edge(raw, n * sign) {
                likely.push((raw, *p, *n));
            } else {
                let more = places.len() - i - 1;
                if score(likely.len() + more, seen + more) <= bar {
                    return None;
                }
            }
        }
        if seen * 5 < places.len() * 2 {
            return None;
        }
        let mut hits = Vec::with_capacity(likely.len());
        for (i, (raw, p, n)) in likely.iter().enumerate() {
            let mut best = (tolerance, None);
            self.map.within(*raw, *raw, (tolerance.ceil() as i32).min(REACH), |k, _, _| {
                let Some(i) = self.arcs.ideal.get(k) else { return };
                let d = i.at - p;
                let off = d.dot(n).abs();
                if off < best.0 && i.towards_bright.dot(n) * sign > ALONG && d.norm() < tolerance + 1.5 {
                    best = (off, Some(k as u32));
                }
            });
            match best.1 {
                Some(k) => hits.push(k),
                None if score(hits.len() + likely.len() - i - 1, seen) <= bar => return None,
                None => {}
            }
        }
        let coverage = hits.len() as f64 / seen.max(1) as f64;
        Some(Trial { ellipse: *e, bright_inside, coverage, score: score(hits.len(), seen), hits })
    }

    /// Fits a trial again to the edges it gathered until it stops changing; it must go on passing the seed.
    fn settle(&self, start: Trial, s: &IdealEdge) -> Trial {
        let mut best = start;
        for k in 0..6 {
            let mut sums = Sums::new(best.ellipse.centre, best.ellipse.a);
            for e in best.hits.iter().filter_map(|k| self.arcs.ideal.get(*k as usize)) {
                sums.add(e.at, 1.0);
            }
            // The seed and its neighbourhood hold the ellipse to the contour that was meant.
            sums.add(s.at, 0.1 * best.hits.len() as f64);
            let Some(e) = sums.ellipse() else { break };
            let tolerance = if k < 2 { 3.0 } else { 2.0 };
            let Some(t) = self.judge(&e, best.bright_inside, tolerance, f64::NEG_INFINITY) else { break };
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
