//! Reference results: the maximum-likelihood rim on exact edge points with a given rig, and the end pose of a converged
//! servo loop.
//!
//! Independent of the off-line stage that is judged: numeric derivatives, no gates, only the camera model is shared.

use graspd_rt::geom::{Pixel, Pose, Rig, Vec3, View, exp_twist};
use graspd_rt::gripper::Gripper;
use graspd_rt::setpoint::Goal;
use nalgebra::{DMatrix, DVector, Matrix2, Matrix3, Point3, Rotation3, UnitQuaternion, Vector2};
use std::f64::consts::TAU;

/// Edge points per image on an unoccluded rim.
pub const POINTS: usize = 150;
/// Iterations of a fit; it ends earlier when it converges.
const MAX_ITERATIONS: usize = 40;

/// A rim in space: a plane circle or ellipse, or a round bar bent to a circle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shape {
    /// Centre, metres; of the core circle for a bar.
    pub centre: Vec3,
    /// Unit normal, towards the cameras.
    pub normal: Vec3,
    /// Unit direction of the semi-axis `a`.
    pub axis_a: Vec3,
    /// Semi-axes, metres; equal for a circle and for a bar's core.
    pub axes: [f64; 2],
    /// Radius of the bar, metres; `None` for a plane edge.
    pub bar: Option<f64>,
}

impl Shape {
    /// A plane circle, or the core circle of a bar.
    pub fn circle(centre: Vec3, normal: Vec3, radius: f64, bar: Option<f64>) -> Self {
        Self { centre, normal, axis_a: frame(&normal)[0], axes: [radius; 2], bar }
    }

    /// Frame at the centre, z along the normal.
    pub fn pose(&self) -> Pose {
        let y = self.normal.cross(&self.axis_a);
        let m = Matrix3::from_columns(&[self.axis_a, y, self.normal]);
        let r = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(m));
        Pose::from_parts(self.centre.into(), r)
    }

    /// Point of a plane rim, or of a bar's core, at an angle from `axis_a`.
    pub fn point(&self, angle: f64) -> Vec3 {
        let y = self.normal.cross(&self.axis_a);
        self.centre + self.axis_a * (self.axes[0] * angle.cos()) + y * (self.axes[1] * angle.sin())
    }

    /// Points of the outer and inner outline of a bar at a core angle, seen from `eye`; `None` for a plane edge.
    ///
    /// On the tube around core direction `e` the surface normal `m = e cos v + n sin v` is perpendicular to the viewing
    /// ray: `m . d = -r`, with `d` from the camera centre to the core point.
    pub fn outlines(&self, eye: &Vec3, angle: f64) -> Option<[Vec3; 2]> {
        let bar = self.bar?;
        let core = self.point(angle);
        let e = (core - self.centre).normalize();
        let d = core - eye;
        let (x, y) = (e.dot(&d), self.normal.dot(&d));
        let half = (-bar / x.hypot(y)).clamp(-1.0, 1.0).acos();
        let mut v = [y.atan2(x) + half, y.atan2(x) - half];
        if v[1].cos() > v[0].cos() {
            v.swap(0, 1);
        }
        Some(v.map(|v| core + (e * v.cos() + self.normal * v.sin()) * bar))
    }

    /// Number of parameters: circle 6, ellipse 8, bar 7.
    fn parameters(&self) -> usize {
        match self.bar {
            Some(_) => 7,
            None if self.axes[0] == self.axes[1] => 6,
            None => 8,
        }
    }

    /// Signed distance of a ray from the rim, metres: from the curve in its plane, or from the bar's surface.
    fn distance(&self, s: &Matrix2<f64>, ray: &Ray) -> f64 {
        let y = self.normal.cross(&self.axis_a);
        if let Some(bar) = self.bar {
            return self.distance_to_core(ray, &y) - bar;
        }
        let t = (self.centre - ray.eye).dot(&self.normal) / ray.way.dot(&self.normal);
        let p = ray.eye + ray.way * t - self.centre;
        let in_plane = Vector2::new(p.dot(&self.axis_a), p.dot(&y));
        s.try_inverse().map_or(f64::NAN, |i| ((i * in_plane).norm() - 1.0) * self.axes[0])
    }

    /// Distance of a ray from the bar's core circle, by Newton iterations on the angle.
    fn distance_to_core(&self, ray: &Ray, y: &Vec3) -> f64 {
        let radius = self.axes[0];
        let across = |v: Vec3| v - ray.way * ray.way.dot(&v);
        let t = (self.centre - ray.eye).dot(&self.normal) / ray.way.dot(&self.normal);
        let p = ray.eye + ray.way * t - self.centre;
        let mut angle = p.dot(y).atan2(p.dot(&self.axis_a));
        let (c, u, v) = (across(self.centre - ray.eye), across(self.axis_a * radius), across(y * radius));
        for _ in 0..20 {
            let (sin, cos) = angle.sin_cos();
            let at = c + u * cos + v * sin;
            let (first, second) = (v * cos - u * sin, -(u * cos + v * sin));
            let (slope, bend) = (at.dot(&first), first.dot(&first) + at.dot(&second));
            let step = if bend > 0.0 { -slope / bend } else { -0.1 * slope.signum() }.clamp(-0.3, 0.3);
            angle += step;
            if step.abs() < 1e-12 {
                break;
            }
        }
        (c + u * angle.cos() + v * angle.sin()).norm()
    }
}

/// Two unit vectors perpendicular to a normal.
fn frame(n: &Vec3) -> [Vec3; 2] {
    let x = if n.x.abs() < 0.9 { Vec3::x() } else { Vec3::y() };
    let x = (x - n * n.dot(&x)).normalize();
    [x, n.cross(&x)]
}

/// A viewing ray in the left camera's frame.
#[derive(Clone, Copy)]
struct Ray {
    eye: Vec3,
    way: Vec3,
}

fn ray(rig: &Rig, view: View, pixel: Pixel) -> Option<Ray> {
    let to_left = rig.view_from_left(view).inverse();
    Some(Ray { eye: rig.centre(view), way: to_left.rotation * rig.camera(view).ray(pixel)? })
}

/// The ray of a pixel and those half a pixel to its four sides, for the derivative of a distance by the pixel position.
struct Seen {
    at: Ray,
    around: [Ray; 4],
}

/// The shape changed by parameters: centre, tilt, then radius, or symmetric shape matrix, or core and bar radius.
fn moved(start: &Shape, x: &DVector<f64>) -> (Shape, Matrix2<f64>) {
    let y = start.normal.cross(&start.axis_a);
    let unit = start.axes[0];
    let mut out = *start;
    out.centre += Vec3::new(x[0], x[1], x[2]) * unit;
    out.normal = (start.normal + start.axis_a * x[3] + y * x[4]).normalize();
    out.axis_a = (start.axis_a - out.normal * out.normal.dot(&start.axis_a)).normalize();
    let mut s = Matrix2::new(start.axes[0], 0.0, 0.0, start.axes[1]);
    match x.len() {
        8 => s += Matrix2::new(x[5], x[6], x[6], x[7]) * unit,
        n => {
            s *= 1.0 + x[5];
            out.axes = start.axes.map(|a| a * (1.0 + x[5]));
            if n == 7 {
                out.bar = start.bar.map(|b| b * (1.0 + x[6]));
            }
        }
    }
    (out, s)
}

/// Minimises a sum of squares by damped Gauss-Newton iterations with numeric derivatives.
fn minimise(n: usize, residuals: impl Fn(&DVector<f64>) -> Option<DVector<f64>>) -> Option<DVector<f64>> {
    const H: f64 = 1e-6;
    let mut x = DVector::zeros(n);
    let mut r = residuals(&x)?;
    let mut damping = 1e-6;
    for _ in 0..MAX_ITERATIONS {
        let mut j = DMatrix::zeros(r.len(), n);
        for k in 0..n {
            let mut ahead = x.clone();
            ahead[k] += H;
            let mut behind = x.clone();
            behind[k] -= H;
            j.set_column(k, &((residuals(&ahead)? - residuals(&behind)?) / (2.0 * H)));
        }
        let (normal, gradient) = (j.transpose() * &j, j.transpose() * &r);
        let mut length = f64::INFINITY;
        for _ in 0..12 {
            let mut m = normal.clone();
            for k in 0..n {
                m[(k, k)] *= 1.0 + damping;
            }
            let step = -m.cholesky()?.solve(&gradient);
            let tried = &x + &step;
            match residuals(&tried).filter(|t| t.norm_squared() <= r.norm_squared()) {
                Some(t) => {
                    (x, r, length) = (tried, t, step.norm());
                    damping = (damping * 0.1).max(1e-12);
                    break;
                }
                None => damping = (damping * 10.0).max(1e-9),
            }
        }
        if !(1e-10..f64::INFINITY).contains(&length) {
            break;
        }
    }
    Some(x)
}

/// The rim that fits raw edge pixels best for a given rig, starting from `start`: distances in pixels, equal weights.
pub fn best_fit(start: &Shape, pixels: &[Vec<Pixel>; 2], rig: &Rig) -> Option<Shape> {
    let mut seen = Vec::new();
    for view in View::BOTH {
        for p in &pixels[view.index()] {
            let side = [(0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5)].map(|(u, v)| p + Pixel::new(u, v));
            let [Some(a), Some(b), Some(c), Some(d)] = side.map(|p| ray(rig, view, p)) else { return None };
            seen.push(Seen { at: ray(rig, view, *p)?, around: [a, b, c, d] });
        }
    }
    let mut shape = *start;
    // The derivative of a distance by the pixel position depends on the shape: fit and derivative alternate.
    for _ in 0..4 {
        let s = Matrix2::new(shape.axes[0], 0.0, 0.0, shape.axes[1]);
        let weight: Vec<f64> = seen
            .iter()
            .map(|q| {
                let d = q.around.map(|r| shape.distance(&s, &r));
                1.0 / (d[0] - d[1]).hypot(d[2] - d[3])
            })
            .collect();
        let n = start.parameters();
        let x = minimise(n, |x| {
            let (moved, s) = moved(&shape, x);
            let r = DVector::from_iterator(
                seen.len(),
                seen.iter().zip(&weight).map(|(q, w)| moved.distance(&s, &q.at) * w),
            );
            r.iter().all(|v| v.is_finite()).then_some(r)
        })?;
        let (next, s) = moved(&shape, &x);
        shape = if n == 8 { with_shape(next, &s) } else { next };
    }
    Some(shape)
}

/// Axes and their direction from the symmetric shape matrix.
fn with_shape(mut shape: Shape, s: &Matrix2<f64>) -> Shape {
    let e = s.symmetric_eigen();
    let major = e.eigenvalues.imax();
    let (a, v) = (e.eigenvalues[major], e.eigenvectors.column(major));
    let y = shape.normal.cross(&shape.axis_a);
    shape.axis_a = (shape.axis_a * v[0] + y * v[1]).normalize();
    shape.axes = [a, e.eigenvalues[1 - major]];
    shape
}

/// Gripper pose of a converged servo loop with the true cameras: the least-squares fit of the projected marks to the
/// goal's predicted pixels in both images.
pub fn loop_ends(goal: &Goal, gripper: &Gripper, true_rig: &Rig) -> Option<Pose> {
    let predicted: Vec<(View, Vec3, Pixel)> = View::BOTH
        .into_iter()
        .flat_map(|v| {
            let marks = gripper.marks.iter().zip(goal.marks[v.index()]);
            marks.filter_map(move |(m, p)| p.map(|p| (v, m.position, p))).collect::<Vec<_>>()
        })
        .collect();
    let pose = |x: &DVector<f64>| {
        // Rotations in radians, translations in decimetres: both then have similar effects on the pixels.
        let v = Vec3::new(x[0], x[1], x[2]) * 0.1;
        let twist = [v.x, v.y, v.z, x[3], x[4], x[5]];
        goal.left_from_gripper * exp_twist(&twist.into())
    };
    let x = minimise(6, |x| {
        let pose = pose(x);
        let mut r = Vec::with_capacity(2 * predicted.len());
        for (view, mark, pixel) in &predicted {
            let d = true_rig.project(*view, &(pose * Point3::from(*mark)).coords)? - pixel;
            r.extend([d.x, d.y]);
        }
        Some(DVector::from_vec(r))
    })?;
    Some(pose(&x))
}

/// `n` equally spaced angles.
pub fn around(n: usize) -> impl Iterator<Item = f64> {
    (0..n).map(move |k| TAU * k as f64 / n as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use graspd_hil::scenario::{Options, Scenario, default_gripper};

    fn rigs() -> (Rig, Rig) {
        let options = Options { with_arm: false, focal_error: 0.005, rotation_error_deg: 0.1, ..Options::default() };
        let s = Scenario::from_seed(3, &options).unwrap();
        (s.true_rig, s.given_rig)
    }

    /// A rim of every kind in front of the rig, with the exact raw pixels of its edges.
    fn shapes(rig: &Rig) -> Vec<(Shape, [Vec<Pixel>; 2])> {
        let middle = 0.5 * rig.centre(View::Right) + Vec3::new(0.0, 0.02, 0.0);
        let ahead = (left_axis(rig) * 1.5 + middle, (-left_axis(rig) + Vec3::new(0.1, 0.3, 0.0)).normalize());
        let circle = Shape::circle(ahead.0, ahead.1, 0.075, None);
        let ellipse = Shape { axes: [0.08, 0.06], ..circle };
        let bar = Shape { bar: Some(0.012), ..circle };
        let project = |view: View, x: Vec3| rig.project(view, &x).unwrap();
        [circle, ellipse, bar]
            .into_iter()
            .map(|s| {
                let pixels = View::BOTH.map(|v| match s.bar {
                    None => around(POINTS).map(|a| project(v, s.point(a))).collect(),
                    Some(_) => around(POINTS / 2)
                        .flat_map(|a| s.outlines(&rig.centre(v), a).unwrap())
                        .map(|x| project(v, x))
                        .collect(),
                });
                (s, pixels)
            })
            .collect()
    }

    /// Direction from between the cameras to where their axes come together.
    fn left_axis(rig: &Rig) -> Vec3 {
        (Vec3::z() * 1.5 - 0.5 * rig.centre(View::Right)).normalize()
    }

    fn off(a: &Shape, b: &Shape) -> [f64; 2] {
        [(a.centre - b.centre).norm() * 1e3, a.normal.cross(&b.normal).norm().asin().to_degrees()]
    }

    #[test]
    fn exact_edges_and_the_true_rig_reproduce_the_rim_from_a_displaced_start() {
        let (rig, _) = rigs();
        for (truth, pixels) in shapes(&rig) {
            let mut start = truth;
            start.centre += Vec3::new(0.002, -0.003, 0.01);
            start.normal = (truth.normal + truth.axis_a * 0.03).normalize();
            start.axis_a = (truth.axis_a - start.normal * start.normal.dot(&truth.axis_a)).normalize();
            start.axes = truth.axes.map(|a| a * 1.02);
            let fit = best_fit(&start, &pixels, &rig).unwrap();
            let [mm, deg] = off(&fit, &truth);
            assert!(mm < 1e-4 && deg < 1e-4, "{truth:?}: {mm} mm, {deg} deg");
            assert!((fit.axes[0] - truth.axes[0]).abs() < 1e-7 && (fit.axes[1] - truth.axes[1]).abs() < 1e-7);
            assert!(fit.bar.zip(truth.bar).is_none_or(|(a, b)| (a - b).abs() < 1e-7));
        }
    }

    #[test]
    fn a_wrong_rig_causes_an_error_in_depth_and_a_small_one_in_the_normal() {
        let (rig, given) = rigs();
        for (truth, pixels) in shapes(&rig) {
            let [mm, deg] = off(&best_fit(&truth, &pixels, &given).unwrap(), &truth);
            // Half a percent of focal length is 7.5 mm at 1.5 m, 0.1 degrees of rotation 7.9 mm at a baseline of 0.5 m.
            assert!((0.3..17.0).contains(&mm) && deg < 0.5, "{truth:?}: {mm} mm, {deg} deg");
        }
    }

    #[test]
    fn a_loop_ends_at_the_goal_only_with_the_rig_that_predicted_the_marks() {
        let (rig, given) = rigs();
        let gripper = default_gripper().gripper;
        let at = shapes(&rig)[0].0.pose();
        let turn = UnitQuaternion::from_axis_angle(&Vec3::x_axis(), std::f64::consts::PI);
        let goal_pose = at * Pose::from_parts(Vec3::new(0.0, 0.0, 0.02).into(), turn);
        let mut goal = Goal { left_from_gripper: goal_pose, marks: Default::default() };
        for v in View::BOTH {
            for (slot, m) in goal.marks[v.index()].iter_mut().zip(&gripper.marks) {
                *slot = rig.project(v, &(goal_pose * Point3::from(m.position)).coords);
            }
        }
        let between = |a: &Pose, b: &Pose| (a.translation.vector - b.translation.vector).norm() * 1e3;
        // From a displaced start.
        goal.left_from_gripper = goal_pose * Pose::translation(0.004, -0.003, 0.01);
        assert!(between(&loop_ends(&goal, &gripper, &rig).unwrap(), &goal_pose) < 1e-5);
        assert!(between(&loop_ends(&goal, &gripper, &given).unwrap(), &goal_pose) > 0.3);
    }
}
