//! Trial ellipses through a seed edge, and how well the edges of the picture support them.

use crate::offline::contour::quick_fit::{Sums, Walk};
use crate::offline::contour::{LEAST_COVERAGE, ViewEdges, alike};
use crate::offline::edges::arcs::IdealEdge;
use crate::offline::rim::model::Ellipse2;

/// Places at which a trial ellipse is judged at most.
pub(super) const MOST_PLACES: usize = 160;

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

impl ViewEdges<'_> {
    /// Trial ellipses through a seed edge, best first, at most `keep` and no two alike.
    pub(in crate::offline) fn trials(&self, seed: usize, keep: usize) -> Vec<Trial> {
        let (Some(s), Some(own)) = (self.arcs.ideal.get(seed), self.arcs.of(seed)) else { return Vec::new() };
        let Some(arc) = self.arcs.arcs.get(own) else { return Vec::new() };
        if !s.at.x.is_finite() {
            return Vec::new();
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
        let mut best = Best { found: Vec::new(), most: 4 * keep };
        for half in [25, 50, 100, 200, 5000] {
            best.offer(self.trial(&piece(half), &s, best.bar()));
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
            best.offer(self.trial(&near.plus(&sums), &s, best.bar()));
        }
        let mut out: Vec<Trial> = Vec::new();
        for t in best.found {
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

    /// The ellipse of some sums as a trial, if it passes the seed in the seed's direction. `bar` as in [`Self::judge`].
    fn trial(&self, sums: &Sums, s: &IdealEdge, bar: f64) -> Option<Trial> {
        let e = sums.ellipse()?;
        let (d, n, _) = Walk::new(&e).measure(s.at);
        let along = s.towards_bright.dot(&n);
        if d.abs() > 2.5 || along.abs() < 0.9 {
            return None;
        }
        self.judge(&e, along < 0.0, 3.0, bar)
    }

    /// Judges an ellipse by the edges along it; `None` as soon as its score cannot exceed the bar any more.
    fn judge(&self, e: &Ellipse2, bright_inside: bool, tolerance: f64, bar: f64) -> Option<Trial> {
        let most = 1.5 * self.map.width().max(self.map.height()) as f64;
        if !(e.b > 4.0 && e.a < most && e.b > 0.04 * e.a) {
            return None;
        }
        let w = Walk::new(e);
        let sign = if bright_inside { -1.0 } else { 1.0 };
        let root = w.perimeter().sqrt();
        let score = |hits: usize, seen: usize| {
            let coverage = hits as f64 / seen.max(1) as f64;
            coverage * coverage * root
        };
        let places = w.places(3.0, MOST_PLACES, &self.turn);
        let (mut seen, mut hits) = (0usize, Vec::with_capacity(places.len()));
        for (i, (p, n)) in places.iter().enumerate() {
            let raw = self.lens.raw(*p);
            if !self.picture.contains(raw, 6.0) {
                continue;
            }
            seen += 1;
            let mut best = (tolerance, None);
            self.map.near(raw, tolerance.ceil() as i32).for_each(|(k, _)| {
                let Some(i) = self.arcs.ideal.get(k) else { return };
                let d = i.at - p;
                let off = d.dot(n).abs();
                if off < best.0 && i.towards_bright.dot(n) * sign > 0.94 && d.norm() < tolerance + 1.5 {
                    best = (off, Some(k as u32));
                }
            });
            match best.1 {
                Some(k) => hits.push(k),
                None => {
                    let more = places.len() - i - 1;
                    if score(hits.len() + more, seen + more) <= bar {
                        return None;
                    }
                }
            }
        }
        if seen * 5 < places.len() * 2 {
            return None;
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
