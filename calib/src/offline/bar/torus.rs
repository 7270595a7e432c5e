//! The outline of a round bar bent to a circle: an edge point's viewing ray touches the tube, so its distance to the core circle is the
//! bar's radius, on the outer and on the inner outline alike.

use crate::offline::conic::eigen;
use crate::offline::conic::levenberg::{self, Linear, Problem};
use crate::offline::rim::circle::frame_of;
use crate::offline::rim::cone::camera_centre;
use crate::offline::rim::model::{EdgePoint, Projection};
use nalgebra::{SMatrix, SVector, Vector3};

/// A torus: core circle and bar.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Torus {
    /// Centre of the core circle.
    pub centre: Vector3<f64>,
    /// Unit normal of its plane.
    pub normal: Vector3<f64>,
    /// Core radius `R`.
    pub core: f64,
    /// Bar radius `r`.
    pub bar: f64,
}

/// The viewing ray of an edge point.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ray {
    origin: Vector3<f64>,
    direction: Vector3<f64>,
    /// Change of the unit direction per pixel along u and v, up to a part along the ray.
    per_pixel: [Vector3<f64>; 2],
    sigma: f64,
}

/// The rays of a view's points; `None` when the camera is not finite.
pub(crate) fn rays(points: &[EdgePoint], p: &Projection) -> Option<Vec<Ray>> {
    let origin = camera_centre(p)?;
    let m = p.fixed_view::<3, 3>(0, 0).into_owned();
    let inverse = m.try_inverse()?;
    let front = m.determinant().signum();
    let third = Vector3::new(p[(2, 0)], p[(2, 1)], p[(2, 2)]);
    points
        .iter()
        .map(|q| {
            let d = inverse * Vector3::new(q.uv.x, q.uv.y, 1.0);
            let sign = (third.dot(&d) * front).signum();
            let k = sign / d.norm();
            let ray = Ray {
                origin,
                direction: d * k,
                per_pixel: [inverse.column(0) * k, inverse.column(1) * k],
                sigma: q.sigma,
            };
            ray.direction.iter().all(|x| x.is_finite()).then_some(ray)
        })
        .collect()
}

/// Where a ray comes closest to the core circle.
struct Closest {
    /// Direction of the core point from the centre.
    e: Vector3<f64>,
    /// Unit vector from the core point to the ray's foot.
    w: Vector3<f64>,
    distance: f64,
    /// Change of the distance per pixel.
    slope: f64,
}

/// Axes of a torus' plane.
#[derive(Clone, Copy)]
struct Axes {
    e1: Vector3<f64>,
    e2: Vector3<f64>,
}

impl Torus {
    fn axes(&self) -> Axes {
        let f = frame_of(&self.normal);
        Axes { e1: f.column(0).into_owned(), e2: f.column(1).into_owned() }
    }

    /// Closest approach by at most 12 guarded Newton steps from the angle at which the ray pierces the plane.
    fn closest(&self, ray: &Ray, axes: &Axes) -> Option<Closest> {
        let down = ray.direction.dot(&self.normal);
        let to = self.centre - ray.origin;
        let reach = if down.abs() > 0.02 { to.dot(&self.normal) / down } else { to.dot(&ray.direction) };
        let x = ray.origin + ray.direction * reach - self.centre;
        let mut u = x.dot(&axes.e2).atan2(x.dot(&axes.e1));
        let perpendicular = |v: &Vector3<f64>| v - ray.direction * ray.direction.dot(v);
        for _ in 0..12 {
            let (s, c) = u.sin_cos();
            let e = axes.e1 * c + axes.e2 * s;
            let t = (axes.e2 * c - axes.e1 * s) * self.core;
            let v = perpendicular(&(to + e * self.core));
            let along = ray.direction.dot(&t);
            let slope = v.dot(&t);
            let bend = t.norm_squared() - along * along - v.dot(&e) * self.core;
            let step = if bend > 1e-3 * self.core * self.core { -slope / bend } else { -0.1 * slope.signum() };
            let step = step.clamp(-0.3, 0.3);
            u += step;
            if step.abs() < 1e-10 {
                break;
            }
        }
        let (s, c) = u.sin_cos();
        let e = axes.e1 * c + axes.e2 * s;
        let core = to + e * self.core;
        let v = perpendicular(&core);
        let distance = v.norm();
        let w = -v / distance;
        let depth = ray.direction.dot(&core);
        let slope = depth * w.dot(&ray.per_pixel[0]).hypot(w.dot(&ray.per_pixel[1]));
        (distance > 0.0 && slope > 0.0 && slope.is_finite()).then_some(Closest { e, w, distance, slope })
    }

    /// Residual of a ray in pixels: how far the edge point is from the outline, positive away from the bar.
    pub(crate) fn residual(&self, ray: &Ray) -> f64 {
        self.closest(ray, &self.axes()).map_or(f64::NAN, |c| (c.distance - self.bar) / c.slope)
    }
}

/// Which of the torus' parameters are adjusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Free {
    /// Centre, normal, core and bar radius.
    All,
    /// The bar's radius is known.
    KnownBar,
    /// One view fixes everything but the scale: the core radius is held.
    OneView,
    /// Both radii are held: one outline of one view determines no more than the pose.
    Pose,
}

/// A fitted torus.
#[derive(Clone, Debug)]
pub(crate) struct TorusFit {
    pub(crate) torus: Torus,
    /// Weighted sum of squared residuals over the rays kept.
    pub(crate) chi2: f64,
    pub(crate) parameters: usize,
    /// Inverse normal matrix of centre, normal (columns of [`frame_of`]), and the free radii; `None` when it is singular.
    pub(crate) cofactor: Option<SMatrix<f64, 7, 7>>,
}

/// The least-squares problem with the pixel scale of every ray held: repeated until the scales stand still.
struct Fit<'a> {
    rays: &'a [Ray],
    keep: &'a [bool],
    /// `1 / (sigma slope)` of each ray: turns a distance into a residual in units of sigma.
    weight: &'a [f64],
    unit: f64,
    free: Free,
}

impl Problem<7> for Fit<'_> {
    type State = Torus;

    fn parameters(&self) -> usize {
        match self.free {
            Free::All => 7,
            Free::KnownBar | Free::OneView => 6,
            Free::Pose => 5,
        }
    }

    fn linearise(&self, x: &Torus) -> Option<Linear<7>> {
        let axes = x.axes();
        let n = self.parameters();
        let mut out = Linear { cost: 0.0, gradient: SVector::zeros(), normal: SMatrix::zeros() };
        for ((ray, keep), weight) in self.rays.iter().zip(self.keep).zip(self.weight) {
            if !keep {
                continue;
            }
            let c = x.closest(ray, &axes)?;
            let r = (c.distance - x.bar) * weight;
            // The foot's own motion does not count: it is the closest point (envelope theorem).
            let k = self.unit * weight;
            let tip = x.core * c.w.dot(&x.normal) * weight;
            let mut j = SVector::<f64, 7>::zeros();
            for i in 0..3 {
                j[i] = -c.w[i] * k;
            }
            j[3] = tip * axes.e1.dot(&c.e);
            j[4] = tip * axes.e2.dot(&c.e);
            match self.free {
                Free::All => {
                    j[5] = -c.w.dot(&c.e) * k;
                    j[6] = -k;
                }
                Free::KnownBar => j[5] = -c.w.dot(&c.e) * k,
                Free::OneView => j[5] = -k,
                Free::Pose => {}
            }
            out.cost += r * r;
            for a in 0..n {
                out.gradient[a] += j[a] * r;
                for b in 0..=a {
                    out.normal[(a, b)] += j[a] * j[b];
                }
            }
        }
        for a in 0..n {
            for b in a + 1..n {
                out.normal[(a, b)] = out.normal[(b, a)];
            }
        }
        Some(out)
    }

    fn cost(&self, x: &Torus) -> Option<f64> {
        if !(x.core > 0.0 && x.bar > 0.0 && x.bar < 0.95 * x.core) {
            return None;
        }
        let axes = x.axes();
        let mut cost = 0.0;
        for ((ray, keep), weight) in self.rays.iter().zip(self.keep).zip(self.weight) {
            if *keep {
                let r = (x.closest(ray, &axes)?.distance - x.bar) * weight;
                cost += r * r;
            }
        }
        cost.is_finite().then_some(cost)
    }

    fn step(&self, x: &Torus, d: &SVector<f64, 7>) -> Torus {
        let axes = x.axes();
        let mut y = *x;
        y.centre += Vector3::new(d[0], d[1], d[2]) * self.unit;
        y.normal = (x.normal + axes.e1 * d[3] + axes.e2 * d[4]).normalize();
        match self.free {
            Free::All => {
                y.core += d[5] * self.unit;
                y.bar += d[6] * self.unit;
            }
            Free::KnownBar => y.core += d[5] * self.unit,
            Free::OneView => y.bar += d[5] * self.unit,
            Free::Pose => {}
        }
        y
    }
}

/// Fits a torus to rays from a start.
pub(crate) fn fit(rays: &[Ray], keep: &[bool], start: &Torus, free: Free) -> Option<TorusFit> {
    let unit = start.core;
    let mut torus = *start;
    let mut found = None;
    for _ in 0..6 {
        let axes = torus.axes();
        let weight: Vec<f64> =
            rays.iter().map(|r| torus.closest(r, &axes).map_or(0.0, |c| 1.0 / (r.sigma * c.slope))).collect();
        let problem = Fit { rays, keep, weight: &weight, unit, free };
        let minimum = levenberg::minimise(&problem, torus, 40)?;
        let moved = (minimum.state.centre - torus.centre).norm() / unit + (minimum.state.normal - torus.normal).norm();
        torus = minimum.state;
        let n = problem.parameters();
        let mut scale = SVector::<f64, 7>::from_element(unit);
        scale[3] = 1.0;
        scale[4] = 1.0;
        let cofactor =
            eigen::invert(&minimum.normal, n).map(|c| SMatrix::from_fn(|i, j| c[(i, j)] * scale[i] * scale[j]));
        found = Some(TorusFit { torus, chi2: minimum.cost, parameters: n, cofactor });
        if moved < 1e-9 {
            break;
        }
    }
    // The last scales belong to the state before the last: the cost that counts is the one in pixels at the end.
    if let Some(f) = &mut found {
        let axes = f.torus.axes();
        f.chi2 = 0.0;
        for (ray, keep) in rays.iter().zip(keep) {
            if *keep {
                let c = f.torus.closest(ray, &axes)?;
                let r = (c.distance - f.torus.bar) / (ray.sigma * c.slope);
                f.chi2 += r * r;
            }
        }
    }
    found
}

/// Points of a torus' outline seen from a place: outer and inner solution at every core angle (each `None` where there is none).
///
/// At core direction `e` the tube's angle `v` obeys `A cos v + B sin v = -r`, `A = e . (C + R e - O)`, `B = n . (C + R e - O)`.
pub fn outline(torus: &Torus, eye: &Vector3<f64>, angle: f64) -> Option<[Vector3<f64>; 2]> {
    let axes = torus.axes();
    let e = axes.e1 * angle.cos() + axes.e2 * angle.sin();
    let d = torus.centre + e * torus.core - eye;
    let (a, b) = (e.dot(&d), torus.normal.dot(&d));
    let h = a.hypot(b);
    if !(h > torus.bar) {
        return None;
    }
    let (middle, half) = (b.atan2(a), (-torus.bar / h).acos());
    let mut v = [middle + half, middle - half];
    if v[1].cos() > v[0].cos() {
        v.swap(0, 1);
    }
    Some(v.map(|v| torus.centre + e * (torus.core + torus.bar * v.cos()) + torus.normal * (torus.bar * v.sin())))
}
