//! The outline of a round bar bent to a circle (a torus): the viewing ray of an edge point touches the tube, so that
//! its distance from the core circle is the bar's radius, on the outer and on the inner outline alike.

use crate::offline::conic::eigen;
use crate::offline::conic::levenberg::{self, Linear, Problem};
use crate::offline::rim::circle::frame_of;
use crate::offline::types::EdgePoint;
use crate::offline::types::projection::Projection;
use crate::offline::types::projection::camera_centre;
use nalgebra::{SMatrix, SVector, Vector2, Vector3};
use std::cell::RefCell;

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
    /// Change of the unit direction per pixel along u and v, up to a component along the ray.
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

/// Closest approach of a ray to the core circle.
struct Closest {
    /// Direction of the core point from the centre.
    e: Vector3<f64>,
    /// Unit vector from the core point to the ray's closest point.
    w: Vector3<f64>,
    distance: f64,
    /// Change of the distance per pixel.
    slope: f64,
    /// Direction of that change in the image.
    gradient: Vector2<f64>,
}

/// Axes of the torus's plane.
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

    /// Closest approach by at most 12 guarded Newton steps, from the angle at which the ray pierces the plane.
    ///
    /// Only the sine and cosine of the angle are needed, which a step rotates, and only the components of the vectors
    /// along the plane's axes.
    fn closest(&self, ray: &Ray, axes: &Axes) -> Option<Closest> {
        let core = self.core;
        let down = ray.direction.dot(&self.normal);
        let to = self.centre - ray.origin;
        let reach = if down.abs() > 0.02 { to.dot(&self.normal) / down } else { to.dot(&ray.direction) };
        let x = ray.origin + ray.direction * reach - self.centre;
        let (x1, x2) = (x.dot(&axes.e1), x.dot(&axes.e2));
        let size = (x1 * x1 + x2 * x2).sqrt();
        let (mut c, mut s) = if size > 0.0 { (x1 / size, x2 / size) } else { (1.0, 0.0) };
        let perpendicular = |v: &Vector3<f64>| v - ray.direction * ray.direction.dot(v);
        let (d1, d2) = (ray.direction.dot(&axes.e1), ray.direction.dot(&axes.e2));
        let across = perpendicular(&to);
        let (q1, q2) = (across.dot(&axes.e1), across.dot(&axes.e2));
        for _ in 0..12 {
            // Components of the ray's direction and of the vector to it, along the core point's direction e and along
            // the core's tangent there.
            let (de, dt) = (d1 * c + d2 * s, d2 * c - d1 * s);
            let (qe, qt) = (q1 * c + q2 * s, q2 * c - q1 * s);
            let slope = core * (qt - core * de * dt);
            let bend = core * (core * (de * de - dt * dt) - qe);
            let step = if bend > 1e-3 * core * core { -slope / bend } else { -0.1 * slope.signum() };
            let step = step.clamp(-0.3, 0.3);
            let (sin, cos) = sin_cos_of_step(step);
            (c, s) = (c * cos - s * sin, s * cos + c * sin);
            if step.abs() < 1e-10 {
                break;
            }
        }
        let e = axes.e1 * c + axes.e2 * s;
        let core = to + e * core;
        let v = perpendicular(&core);
        let distance = v.norm();
        let w = -v / distance;
        let depth = ray.direction.dot(&core);
        let (u, v) = (w.dot(&ray.per_pixel[0]), w.dot(&ray.per_pixel[1]));
        let slope = depth * (u * u + v * v).sqrt();
        let gradient = Vector2::new(u, v) * (depth / slope);
        (distance > 0.0 && slope > 0.0 && slope.is_finite()).then_some(Closest { e, w, distance, slope, gradient })
    }

    /// Distance of a ray's edge point from the outline in pixels, its gradient direction in the image, and the point
    /// of the bar that the ray comes closest to.
    pub(crate) fn touch(&self, ray: &Ray) -> Option<(f64, Vector2<f64>, Vector3<f64>)> {
        let c = self.closest(ray, &self.axes())?;
        let foot = self.centre + c.e * self.core + c.w * self.bar;
        Some(((c.distance - self.bar) / c.slope, c.gradient, foot))
    }

    /// Distance of a ray's edge point from the outline in pixels, positive away from the bar.
    pub(crate) fn residual(&self, ray: &Ray) -> f64 {
        self.closest(ray, &self.axes()).map_or(f64::NAN, |c| (c.distance - self.bar) / c.slope)
    }
}

/// Sine and cosine of an angle of at most 0.3 by their series, to machine precision.
fn sin_cos_of_step(x: f64) -> (f64, f64) {
    let y = x * x;
    let sin = 1.0 - y / 6.0 * (1.0 - y / 20.0 * (1.0 - y / 42.0 * (1.0 - y / 72.0 * (1.0 - y / 110.0))));
    let cos =
        1.0 - y / 2.0 * (1.0 - y / 12.0 * (1.0 - y / 30.0 * (1.0 - y / 56.0 * (1.0 - y / 90.0 * (1.0 - y / 132.0)))));
    (x * sin, cos)
}

/// Which parameters of the torus are adjusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Free {
    /// Centre, normal, core and bar radius.
    All,
    /// The bar's radius is known.
    KnownBar,
    /// One view determines everything but the scale: the core radius is fixed.
    OneView,
    /// Both radii are fixed: one outline of one view determines only the pose.
    Pose,
}

/// A fitted torus.
#[derive(Clone, Debug)]
pub(crate) struct TorusFit {
    pub(crate) torus: Torus,
    /// Weighted sum of squared residuals over the rays kept.
    pub(crate) chi2: f64,
    pub(crate) parameters: usize,
    /// Inverse normal matrix of centre, normal (columns of [`frame_of`]), and the free radii; `None` when it is
    /// singular.
    pub(crate) cofactor: Option<SMatrix<f64, 7, 7>>,
}

/// The least-squares problem with the pixel scale of every ray fixed; repeated until the scales converge.
struct Fit<'a> {
    rays: &'a [Ray],
    /// `1 / (sigma slope)` of each ray: converts a distance to a residual in units of sigma.
    weight: &'a [f64],
    unit: f64,
    free: Free,
    /// Closest approaches to the last torus: a step is first tried, then linearised at the same state.
    closest: &'a RefCell<Approach>,
}

/// A torus with the closest approach of every ray.
struct Approach {
    torus: Torus,
    axes: Axes,
    closest: Vec<Closest>,
    /// Whether every ray has one.
    complete: bool,
}

impl Approach {
    fn new(rays: &[Ray], torus: &Torus) -> Self {
        let mut new =
            Self { torus: *torus, axes: torus.axes(), closest: Vec::with_capacity(rays.len()), complete: false };
        new.fill(rays);
        new
    }

    fn fill(&mut self, rays: &[Ray]) {
        self.closest.clear();
        self.closest.extend(rays.iter().map_while(|r| self.torus.closest(r, &self.axes)));
        self.complete = self.closest.len() == rays.len();
    }

    /// Changes the torus; `None` where a ray has no closest approach.
    fn at(&mut self, rays: &[Ray], torus: &Torus) -> Option<(&Axes, &[Closest])> {
        if self.torus != *torus {
            (self.torus, self.axes) = (*torus, torus.axes());
            self.fill(rays);
        }
        self.complete.then_some((&self.axes, &self.closest))
    }
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
        let mut approach = self.closest.borrow_mut();
        let (axes, closest) = approach.at(self.rays, x)?;
        let n = self.parameters();
        let mut cost = 0.0;
        let mut gradient = [0.0; 7];
        // All seven parameters, whatever is adjusted: loops of known length are faster than fewer iterations.
        let mut normal = [[0.0; 7]; 7];
        for (c, weight) in closest.iter().zip(self.weight) {
            let r = (c.distance - x.bar) * weight;
            // The motion of the closest point itself does not count (envelope theorem).
            let k = self.unit * weight;
            let tip = x.core * c.w.dot(&x.normal) * weight;
            let (by_core, by_bar) = (-c.w.dot(&c.e) * k, -k);
            let (radius, bar) = match self.free {
                Free::All => (by_core, by_bar),
                Free::KnownBar => (by_core, 0.0),
                Free::OneView => (by_bar, 0.0),
                Free::Pose => (0.0, 0.0),
            };
            let (tip1, tip2) = (tip * axes.e1.dot(&c.e), tip * axes.e2.dot(&c.e));
            let j = [-c.w.x * k, -c.w.y * k, -c.w.z * k, tip1, tip2, radius, bar];
            cost += r * r;
            for ((g, row), a) in gradient.iter_mut().zip(&mut normal).zip(&j) {
                *g += a * r;
                row.iter_mut().zip(&j).for_each(|(m, b)| *m += a * b);
            }
        }
        let normal = SMatrix::from_fn(|a, b| if a < n && b < n { normal[a][b] } else { 0.0 });
        Some(Linear { cost, gradient: SVector::from(gradient), normal })
    }

    fn cost(&self, x: &Torus) -> Option<f64> {
        if !(x.core > 0.0 && x.bar > 0.0 && x.bar < 0.95 * x.core) {
            return None;
        }
        let mut approach = self.closest.borrow_mut();
        let (_, closest) = approach.at(self.rays, x)?;
        let cost: f64 = closest.iter().zip(self.weight).map(|(c, w)| (c.distance - x.bar) * w).map(|r| r * r).sum();
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

/// Fits a torus to rays from a start; `None` when the fit leaves the admissible range.
pub(crate) fn fit(rays: &[Ray], keep: &[bool], start: &Torus, free: Free) -> Option<TorusFit> {
    let rays: Vec<Ray> = rays.iter().zip(keep).filter(|(_, k)| **k).map(|(r, _)| *r).collect();
    let unit = start.core;
    let mut torus = *start;
    let mut found = None;
    let approach = RefCell::new(Approach::new(&rays, start));
    for _ in 0..6 {
        let weight: Vec<f64> = {
            let mut approach = approach.borrow_mut();
            let (_, closest) = approach.at(&rays, &torus)?;
            closest.iter().zip(&rays).map(|(c, r)| 1.0 / (r.sigma * c.slope)).collect()
        };
        let problem = Fit { rays: &rays, weight: &weight, unit, free, closest: &approach };
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
    // The last scales belong to the previous state: recompute the cost in pixels at the end.
    if let Some(f) = &mut found {
        let mut approach = approach.borrow_mut();
        let (_, closest) = approach.at(&rays, &f.torus)?;
        let residual = |(c, r): (&Closest, &Ray)| (c.distance - f.torus.bar) / (r.sigma * c.slope);
        f.chi2 = closest.iter().zip(&rays).map(residual).map(|r| r * r).sum();
    }
    found
}

/// Points of the torus's outline seen from `centre`: outer and inner solution at a core angle; `None` where there is
/// none.
///
/// At core direction `e` the tube's angle `v` satisfies `A cos v + B sin v = -r`, `A = e . (C + R e - O)`, `B = n . (C
/// + R e - O)`.
pub fn outline(torus: &Torus, centre: &Vector3<f64>, angle: f64) -> Option<[Vector3<f64>; 2]> {
    let axes = torus.axes();
    let e = axes.e1 * angle.cos() + axes.e2 * angle.sin();
    let d = torus.centre + e * torus.core - centre;
    let (a, b) = (e.dot(&d), torus.normal.dot(&d));
    let h = a.hypot(b);
    if !(h > torus.bar) {
        return None;
    }
    // Cosine and sine of `atan2(b, a)` plus and minus `acos(-r / h)`.
    let ((sm, cm), ch) = ((b / h, a / h), -torus.bar / h);
    let sh = (1.0 - ch * ch).max(0.0).sqrt();
    let mut v = [(cm * ch - sm * sh, sm * ch + cm * sh), (cm * ch + sm * sh, sm * ch - cm * sh)];
    if v[1].0 > v[0].0 {
        v.swap(0, 1);
    }
    Some(v.map(|(cos, sin)| torus.centre + e * (torus.core + torus.bar * cos) + torus.normal * (torus.bar * sin)))
}
