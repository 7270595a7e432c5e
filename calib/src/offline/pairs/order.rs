//! Whether two pictures were given in the wrong order, from everything that is in them.
//!
//! A rim near the middle of a symmetrical rig can be reconstructed from its two contours either way round: the contours alone cannot tell. The rest of
//! the pictures can. Distinct spots of one picture are looked for in the other along the lines, and in front of both cameras, where the rig says that they
//! have to be; in the right order they are found, in the wrong one their lines run elsewhere, or their places lie behind the cameras.

use crate::offline::edges::lens::Lens;
use crate::offline::edges::picture::Picture;
use crate::offline::rim::cone::camera_centre;
use crate::offline::rim::model::Projection;
use graspd_rt::geom::Pixel;
use nalgebra::Vector3;

/// Cells of the left picture that give one spot each, across and down.
const CELLS: [usize; 2] = [12, 10];
/// Half the side of a patch, pixels of the halved picture.
const HALF: i32 = 6;
/// A spot is found where the correlation is at least this.
const FOUND: f64 = 0.75;
/// A spot speaks for an order when it correlates better by this.
const BETTER: f64 = 0.12;
/// Least number of spots that have to speak for the other order.
const LEAST: usize = 6;
/// Nearest distance looked at, in baselines.
const NEAREST: f64 = 0.8;
/// Places tried along a line at most.
const MOST_PLACES: usize = 420;

/// How many spots speak for each order.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Votes {
    /// For the order as given.
    pub as_given: usize,
    /// For the pictures exchanged.
    pub exchanged: usize,
}

impl Votes {
    /// Whether the pictures were given in the wrong order, beyond chance.
    pub fn are_exchanged(&self) -> bool {
        self.exchanged >= LEAST && self.exchanged > 3 * self.as_given
    }

    /// Whether they were given in the right order, beyond chance.
    pub fn are_as_given(&self) -> bool {
        self.as_given >= LEAST && self.as_given > 3 * self.exchanged
    }
}

/// A picture at half its size: quick to search, and blind to the noise.
struct Small {
    w: usize,
    h: usize,
    grey: Vec<f32>,
}

impl Small {
    fn of(p: &Picture) -> Self {
        let (w, h) = (p.width() / 2, p.height() / 2);
        let mut grey = Vec::with_capacity(w * h);
        for y in 0..h {
            let (a, b) = (p.row(2 * y), p.row(2 * y + 1));
            grey.extend(
                a.chunks_exact(2)
                    .zip(b.chunks_exact(2))
                    .take(w)
                    .map(|(a, b)| a.iter().chain(b).map(|v| f32::from(*v)).sum::<f32>() * 0.25),
            );
        }
        Self { w, h, grey }
    }

    /// The patch round a pixel, mean removed and of unit length; `None` at the border and where nothing is.
    fn patch(&self, x: i32, y: i32, least: f32, out: &mut Vec<f32>) -> Option<()> {
        let side = (2 * HALF + 1) as usize;
        let (x0, y0) = (usize::try_from(x - HALF).ok()?, usize::try_from(y - HALF).ok()?);
        if x0 + side > self.w || y0 + side > self.h {
            return None;
        }
        out.clear();
        for row in 0..side {
            let o = (y0 + row) * self.w + x0;
            out.extend_from_slice(self.grey.get(o..o + side)?);
        }
        let n = out.len() as f32;
        let mean = out.iter().sum::<f32>() / n;
        out.iter_mut().for_each(|v| *v -= mean);
        let size = out.iter().map(|v| v * v).sum::<f32>().sqrt();
        if size < least * n.sqrt() {
            return None;
        }
        out.iter_mut().for_each(|v| *v /= size);
        Some(())
    }

    /// Smaller eigenvalue of the structure tensor: large where a patch has detail in both directions.
    fn detail(&self, x: usize, y: usize) -> f32 {
        let g = |x: usize, y: usize| self.grey.get(y * self.w + x).copied().unwrap_or(0.0);
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for v in (y - 4..=y + 4).step_by(2) {
            for u in (x - 4..=x + 4).step_by(2) {
                let (dx, dy) = (g(u + 1, v) - g(u - 1, v), g(u, v + 1) - g(u, v - 1));
                xx += dx * dx;
                xy += dx * dy;
                yy += dy * dy;
            }
        }
        0.5 * (xx + yy - ((xx - yy) * (xx - yy) + 4.0 * xy * xy).sqrt())
    }

    /// The spot with most detail in each cell.
    fn spots(&self) -> Vec<(usize, usize)> {
        let margin = HALF as usize + 6;
        let (cw, ch) = ((self.w.saturating_sub(2 * margin)) / CELLS[0], (self.h.saturating_sub(2 * margin)) / CELLS[1]);
        let mut out = Vec::new();
        for cell in 0..CELLS[0] * CELLS[1] {
            let (x0, y0) = (margin + (cell % CELLS[0]) * cw, margin + (cell / CELLS[0]) * ch);
            let mut best = (0.0f32, None);
            for y in (y0..y0 + ch).step_by(3) {
                for x in (x0..x0 + cw).step_by(3) {
                    let d = self.detail(x, y);
                    if d > best.0 {
                        best = (d, Some((x, y)));
                    }
                }
            }
            out.extend(best.1);
        }
        out
    }
}

/// Lets the spots of the first picture vote on the order of both. `noise` is the pictures' noise in grey levels.
pub fn votes(pictures: [&Picture; 2], lenses: [&Lens; 2], p: [&Projection; 2], noise: f64) -> Votes {
    let mut votes = Votes::default();
    let small = pictures.map(Small::of);
    let (Some(a), Some(b)) = (Ray::new(lenses, p, 0), Ray::new(lenses, p, 1)) else { return votes };
    let least = (1.5 * noise).max(1.0) as f32;
    let (mut wanted, mut there) = (Vec::new(), Vec::new());
    for (x, y) in small[0].spots() {
        if small[0].patch(x as i32, y as i32, least, &mut wanted).is_none() {
            continue;
        }
        let at = Pixel::new(2.0 * x as f64 + 0.5, 2.0 * y as f64 + 0.5);
        // The first picture is the left camera's as given, the right camera's if exchanged.
        let mut best = [-1.0f32; 2];
        for (ray, best) in [&a, &b].into_iter().zip(&mut best) {
            for (u, v) in ray.places(at) {
                if small[1].patch(u, v, 0.5 * least, &mut there).is_some() {
                    let c: f32 = wanted.iter().zip(&there).map(|(a, b)| a * b).sum();
                    *best = best.max(c);
                }
            }
        }
        let [given, other] = best.map(f64::from);
        if given.max(other) >= FOUND && (given - other).abs() >= BETTER {
            *(if given > other { &mut votes.as_given } else { &mut votes.exchanged }) += 1;
        }
    }
    votes
}

/// From a pixel of one camera's picture to its line in the other's.
struct Ray<'a> {
    lenses: [&'a Lens; 2],
    to: &'a Projection,
    eye: Vector3<f64>,
    back: nalgebra::Matrix3<f64>,
    baseline: f64,
}

impl<'a> Ray<'a> {
    fn new(lenses: [&'a Lens; 2], p: [&'a Projection; 2], from: usize) -> Option<Self> {
        let eyes = [camera_centre(p[0])?, camera_centre(p[1])?];
        let m = p[from].fixed_view::<3, 3>(0, 0).into_owned();
        Some(Self {
            lenses: [lenses[from], lenses[1 - from]],
            to: p[1 - from],
            eye: eyes[from],
            back: m.try_inverse()?,
            baseline: (eyes[0] - eyes[1]).norm(),
        })
    }

    /// Half-size pixels of the other picture, one after the other, from near to infinitely far.
    fn places(&self, raw: Pixel) -> Vec<(i32, i32)> {
        let Some(i) = self.lenses[0].ideal(raw) else { return Vec::new() };
        let d = self.back * Vector3::new(i.x, i.y, 1.0);
        let Some(d) = d.try_normalize(0.0) else { return Vec::new() };
        let at = |inverse: f64| -> Option<Pixel> {
            // A point at 1 / inverse along the ray, in homogeneous coordinates so that infinity is a place like any other.
            let h = self.to * (self.eye * inverse + d).push(inverse);
            (h.z > 0.0).then(|| Pixel::new(h.x / h.z, h.y / h.z))
        };
        let nearest = 1.0 / (NEAREST * self.baseline);
        let (Some(near), Some(far)) = ((0..20).find_map(|k| at(nearest * (1.0 - 0.05 * f64::from(k)))), at(0.0)) else {
            return Vec::new();
        };
        let n = (((near - far).norm() / 2.0) as usize).clamp(1, MOST_PLACES);
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
