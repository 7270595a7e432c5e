//! Matches of distinctive patches (spots) between the images, and whether the images were given in the wrong order.
//!
//! A rim near the middle of a symmetrical rig can be reconstructed from its two contours in either order of the
//! images: the contours alone cannot decide. The rest of the images can. Distinctive spots of one image are searched
//! in the other along their epipolar lines and in front of both cameras. In the right order they are found; in the
//! wrong one their lines run elsewhere, or their points lie behind the cameras.

use crate::offline::correspondence::epipolar::Match;
use crate::offline::correspondence::patches::{Small, Totals};
use crate::offline::correspondence::refine;
use crate::offline::edges::grey_image::GreyImage;
use crate::offline::edges::lens::Lens;
use crate::offline::types::projection::Projection;
use crate::offline::types::projection::camera_centre;
use graspd_rt::geom::Pixel;
use nalgebra::Vector3;

/// Smallest correlation of a match.
const MIN_CORRELATION: f64 = 0.75;
/// Smallest difference of the correlations for a vote on the order.
const MIN_ADVANTAGE: f64 = 0.12;
/// Smallest number of votes for a decision on the order.
const MIN_VOTES: usize = 6;
/// Nearest distance that is searched, in baselines.
const MIN_DISTANCE: f64 = 0.8;
/// Largest number of positions along a line.
const MAX_POSITIONS: usize = 420;

/// Votes of the spots for each order of the images.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Votes {
    /// For the order as given.
    pub as_given: usize,
    /// For the images exchanged.
    pub exchanged: usize,
}

impl Votes {
    /// Whether the images were given in the wrong order, beyond chance.
    pub fn are_exchanged(&self) -> bool {
        self.exchanged >= MIN_VOTES && self.exchanged > 3 * self.as_given
    }

    /// Whether the images were given in the right order, beyond chance.
    pub fn are_as_given(&self) -> bool {
        self.as_given >= MIN_VOTES && self.as_given > 3 * self.exchanged
    }
}

/// Votes on the order of two images, and the matches in the order as given.
#[derive(Clone, Debug, Default)]
pub struct Spots {
    /// Votes on the order of the images.
    pub votes: Votes,
    /// Matches in ideal pixels.
    pub matches: Vec<Match>,
}

/// Searches the spots of the first image in the second, in both orders. `noise` is the noise of the images in grey
/// levels.
pub fn spots(images: [&GreyImage; 2], lenses: [&Lens; 2], p: [&Projection; 2], noise: f64) -> Spots {
    let mut out = Spots::default();
    let small = images.map(Small::of);
    let (Some(a), Some(b)) = (Ray::new(lenses, p, 0), Ray::new(lenses, p, 1)) else { return out };
    let least = (1.5 * noise).max(1.0) as f32;
    let totals = Totals::of_image(&small[1]);
    for (x, y) in small[0].spots() {
        let Some(template) = small[0].patch(x as i32, y as i32, least) else { continue };
        let at = Pixel::new(2.0 * x as f64 + 0.5, 2.0 * y as f64 + 0.5);
        // The first image is the left camera's as given, and the right camera's if exchanged.
        let best = |ray: &Ray<'_>| {
            let correlation = |u: i32, v: i32| small[1].correlation(&template, &totals, u, v, 0.5 * least);
            search(&ray.positions(at), correlation)
        };
        let [given, other] = [best(&a), best(&b)];
        let size = [given, other].map(|f| f.map_or(-1.0, |f| f64::from(f.0)));
        if size[0].max(size[1]) >= MIN_CORRELATION && (size[0] - size[1]).abs() >= MIN_ADVANTAGE {
            *(if size[0] > size[1] { &mut out.votes.as_given } else { &mut out.votes.exchanged }) += 1;
        }
        let Some((_, u, v)) = given.filter(|_| size[0] >= MIN_CORRELATION) else { continue };
        let start = Pixel::new(2.0 * f64::from(u) + 0.5, 2.0 * f64::from(v) + 0.5);
        out.matches.extend(refine::refine(images, at, start, noise).and_then(|found| {
            let ideal = [lenses[0].ideal(at)?, lenses[1].ideal(found.at)?];
            let line = a.normal_at(ideal[0])?;
            Some(Match { at: ideal, sigma: found.sigma_along(line) })
        }));
    }
    out
}

/// Number of local maxima along the line from which the search climbs.
const CLIMBS: usize = 3;
/// Largest number of steps of a climb: the error of the rig moves a point off its line by a few pixels of the halved
/// image.
const CLIMB_STEPS: usize = 5;

/// The best correlation near a line: hill climbing from its highest maxima, because the line is only as accurate as
/// the rig.
fn search(positions: &[(i32, i32)], correlation: impl Fn(i32, i32) -> Option<f32>) -> Option<(f32, i32, i32)> {
    let along: Vec<f32> = positions.iter().map(|(u, v)| correlation(*u, *v).unwrap_or(-1.0)).collect();
    let value = |k: Option<usize>| k.and_then(|k| along.get(k)).copied().unwrap_or(-1.0);
    let mut peaks: Vec<(f32, (i32, i32))> = along
        .iter()
        .zip(positions)
        .enumerate()
        .filter(|(k, (c, _))| **c > -1.0 && **c >= value(k.checked_sub(1)) && **c > value(Some(k + 1)))
        .map(|(_, (c, p))| (*c, *p))
        .collect();
    peaks.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut best: Option<(f32, i32, i32)> = None;
    for (c, (u, v)) in peaks.into_iter().take(CLIMBS) {
        let mut at = (c, u, v);
        for _ in 0..CLIMB_STEPS {
            let round = [(-1, -1), (0, -1), (1, -1), (-1, 0), (1, 0), (-1, 1), (0, 1), (1, 1)];
            let next = round
                .iter()
                .filter_map(|(i, j)| correlation(at.1 + i, at.2 + j).map(|c| (c, at.1 + i, at.2 + j)))
                .max_by(|a, b| a.0.total_cmp(&b.0));
            match next.filter(|n| n.0 > at.0) {
                Some(n) => at = n,
                None => break,
            }
        }
        if best.is_none_or(|b| at.0 > b.0) {
            best = Some(at);
        }
    }
    best
}

/// From a pixel of one camera to its epipolar line in the other.
struct Ray<'a> {
    lenses: [&'a Lens; 2],
    to: &'a Projection,
    centre: Vector3<f64>,
    back: nalgebra::Matrix3<f64>,
    baseline: f64,
}

impl<'a> Ray<'a> {
    fn new(lenses: [&'a Lens; 2], p: [&'a Projection; 2], from: usize) -> Option<Self> {
        let centres = [camera_centre(p[0])?, camera_centre(p[1])?];
        let m = p[from].fixed_view::<3, 3>(0, 0).into_owned();
        Some(Self {
            lenses: [lenses[from], lenses[1 - from]],
            to: p[1 - from],
            centre: centres[from],
            back: m.try_inverse()?,
            baseline: (centres[0] - centres[1]).norm(),
        })
    }

    /// Unit normal of an ideal pixel's line in the other image.
    fn normal_at(&self, ideal: Pixel) -> Option<Pixel> {
        let h = self.to * self.centre.push(1.0);
        let d = self.to * (self.back * Vector3::new(ideal.x, ideal.y, 1.0)).push(0.0);
        let l = h.cross(&d);
        Pixel::new(l.x, l.y).try_normalize(1e-12)
    }

    /// Pixels of the other halved image along the line, from near to infinitely far.
    fn positions(&self, raw: Pixel) -> Vec<(i32, i32)> {
        let Some(i) = self.lenses[0].ideal(raw) else { return Vec::new() };
        let d = self.back * Vector3::new(i.x, i.y, 1.0);
        let Some(d) = d.try_normalize(0.0) else { return Vec::new() };
        let at = |inverse: f64| -> Option<Pixel> {
            // A point at distance 1 / inverse along the ray, in homogeneous coordinates so that infinity needs no
            // special case.
            let h = self.to * (self.centre * inverse + d).push(inverse);
            (h.z > 0.0).then(|| Pixel::new(h.x / h.z, h.y / h.z))
        };
        let nearest = 1.0 / (MIN_DISTANCE * self.baseline);
        let (Some(near), Some(far)) = ((0..20).find_map(|k| at(nearest * (1.0 - 0.05 * f64::from(k)))), at(0.0)) else {
            return Vec::new();
        };
        let n = (((near - far).norm() / 2.0) as usize).clamp(1, MAX_POSITIONS);
        let mut out: Vec<(i32, i32)> = Vec::with_capacity(n);
        for k in 0..=n {
            let Some(ideal) = at(nearest * k as f64 / n as f64) else { continue };
            let r = (self.lenses[1].raw(ideal) - Pixel::new(0.5, 0.5)) * 0.5;
            if !(r.x.abs() < 1e5 && r.y.abs() < 1e5) {
                continue;
            }
            let q = (r.x.round() as i32, r.y.round() as i32);
            if out.last() != Some(&q) {
                out.push(q);
            }
        }
        out
    }
}
