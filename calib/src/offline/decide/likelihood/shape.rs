//! The shapes that contours may be images of: a plane circle or ellipse, a round bar. Their outlines in an image, and
//! the derivatives of those by the shape's parameters.

use crate::offline::bar::torus::{Torus, rays};
use crate::offline::conic::sampson::distance;
use crate::offline::conic::{image_of_unit_circle, orient};
use crate::offline::rim::circle::{frame_of, signed_axis};
use crate::offline::rim::model::Rim;
use crate::offline::types::EdgePoint;
use crate::offline::types::projection::Projection;
use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

/// Usual radius of a bar as a fraction of its core radius.
const USUAL_BAR: f64 = 0.12;
/// Standard deviation of the bar radius from the usual one, natural logarithm: hand wheels, handles and pipes lie
/// between a thirtieth and a half.
const BAR_SPREAD: f64 = 0.6;
/// Largest number of parameters of a shape.
pub(super) const PARAMETERS: usize = 8;

/// The shape of a set of contours.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::offline) enum Shape {
    /// A plane circle.
    Circle(Rim),
    /// A plane ellipse, and the prior standard deviation of its unevenness as a fraction of its size.
    Ellipse(Rim, f64),
    /// A round bar, and its known radius with relative standard deviation, if given. The fitted parameter is the
    /// logarithm of the radius.
    Bar(Torus, Option<(f64, f64)>),
}

impl Shape {
    pub(super) fn parameters(&self) -> usize {
        match self {
            Self::Circle(_) => 6,
            Self::Ellipse(..) => 8,
            Self::Bar(..) => 7,
        }
    }

    pub(super) fn centre(&self) -> Vector3<f64> {
        match self {
            Self::Circle(r) | Self::Ellipse(r, _) => r.centre,
            Self::Bar(t, _) => t.centre,
        }
    }

    pub(super) fn normal(&self) -> Vector3<f64> {
        match self {
            Self::Circle(r) | Self::Ellipse(r, _) => r.normal,
            Self::Bar(t, _) => t.normal,
        }
    }

    pub(super) fn size(&self) -> f64 {
        match self {
            Self::Circle(r) | Self::Ellipse(r, _) => r.a,
            Self::Bar(t, _) => t.core,
        }
    }

    /// Prior standard deviation of each parameter in natural units, and the present value's distance from the prior's
    /// mean in that unit. Position and direction are practically free. What distinguishes the models is how far an
    /// ellipse is from round, and how thick a bar is.
    pub(super) fn prior(&self) -> ([f64; PARAMETERS], [f64; PARAMETERS]) {
        let (reach, size) = (self.centre().norm(), self.size());
        let mut sd = [reach, reach, reach, 1.0, 1.0, 0.5 * size, 0.0, 0.0];
        let mut off = [0.0; PARAMETERS];
        match self {
            Self::Circle(_) => {}
            Self::Ellipse(r, uneven) => {
                let s = shape_matrix(r);
                (sd[6], sd[7]) = (uneven * size, uneven * size);
                off[6] = 0.5 * (s[(0, 0)] - s[(1, 1)]) / sd[6];
                off[7] = s[(0, 1)] / sd[7];
            }
            Self::Bar(t, known) => {
                let (mean, spread) = known.unwrap_or((USUAL_BAR * size, BAR_SPREAD));
                sd[6] = spread;
                off[6] = (t.bar / mean).ln() / spread;
            }
        }
        (sd, off)
    }

    /// The shape changed by natural parameters: centre, normal turned towards the axes of `frame_of`, radius (and its
    /// unevenness along and between those axes), or core and bar radius. `None` where the shape collapses.
    pub(super) fn moved(&self, d: &[f64; PARAMETERS]) -> Option<Self> {
        let f = frame_of(&self.normal());
        let normal = (self.normal() + f.column(0) * d[3] + f.column(1) * d[4]).try_normalize(0.1)?;
        let centre = self.centre() + Vector3::new(d[0], d[1], d[2]);
        let plane = |s: Matrix2<f64>| -> Option<Rim> {
            let g = turned_frame(&f, &normal)?;
            rim_of(centre, normal, &g, &s)
        };
        Some(match self {
            Self::Circle(r) => Self::Circle(plane(Matrix2::identity() * (r.a + d[5]))?),
            Self::Ellipse(r, uneven) => {
                let s = shape_matrix(r) + Matrix2::new(d[5] + d[6], d[7], d[7], d[5] - d[6]);
                Self::Ellipse(plane(s)?, *uneven)
            }
            Self::Bar(t, known) => {
                let torus = Torus { centre, normal, core: t.core + d[5], bar: t.bar * d[6].clamp(-1.0, 1.0).exp() };
                if !(torus.bar > 0.0 && torus.bar < 0.95 * torus.core) {
                    return None;
                }
                Self::Bar(torus, *known)
            }
        })
    }

    /// Natural parameters that lead from this shape to a nearby one of its kind.
    pub(super) fn difference(&self, to: &Self) -> [f64; PARAMETERS] {
        let f = frame_of(&self.normal());
        let (c, n) = (to.centre() - self.centre(), to.normal() - self.normal());
        let mut d = [c.x, c.y, c.z, f.column(0).dot(&n), f.column(1).dot(&n), to.size() - self.size(), 0.0, 0.0];
        match (self, to) {
            (Self::Ellipse(a, _), Self::Ellipse(b, _)) => {
                let s = shape_matrix(b) - shape_matrix(a);
                (d[5], d[6], d[7]) = (0.5 * (s[(0, 0)] + s[(1, 1)]), 0.5 * (s[(0, 0)] - s[(1, 1)]), s[(0, 1)]);
            }
            (Self::Bar(a, _), Self::Bar(b, _)) => d[6] = (b.bar / a.bar).ln(),
            _ => {}
        }
        d
    }

    /// A view's points relative to the shape's outline there. `None` where a camera or the image of the shape is
    /// degenerate.
    pub(super) fn outline_points(&self, points: &[EdgePoint], p: &Projection) -> Option<Vec<OutlinePoint>> {
        match self {
            Self::Circle(r) | Self::Ellipse(r, _) => {
                let h = homography(p, r);
                let conic = orient(&image_of_unit_circle(&(h / h.norm())));
                let back = h.try_inverse()?;
                let point = |q: &EdgePoint| {
                    let y = back * q.uv.push(1.0);
                    let on_circle = Vector2::new(y.x / y.z, y.y / y.z).try_normalize(0.0)?;
                    let foot = r.centre + r.axis_a * (r.a * on_circle.x) + r.axis_b * (r.b * on_circle.y);
                    let gradient = (conic * q.uv.push(1.0)).xy().try_normalize(0.0)?;
                    Some(OutlinePoint { residual: distance(&conic, &q.uv), gradient, foot })
                };
                points.iter().map(point).collect()
            }
            Self::Bar(t, _) => rays(points, p)?
                .iter()
                .map(|ray| t.touch(ray).map(|(residual, gradient, foot)| OutlinePoint { residual, gradient, foot }))
                .collect(),
        }
    }

    /// Motion of a point of the outline by each parameter, per unit of the parameter.
    pub(super) fn motions(&self, foot: &Vector3<f64>) -> [Vector3<f64>; PARAMETERS] {
        let f = frame_of(&self.normal());
        let arm = foot - self.centre();
        let (e1, e2, n) = (f.column(0).into_owned(), f.column(1).into_owned(), f.column(2).into_owned());
        let mut out = [Vector3::zeros(); PARAMETERS];
        out[0] = Vector3::x();
        out[1] = Vector3::y();
        out[2] = Vector3::z();
        // A rotation w moves the normal by w x n.
        out[3] = n.cross(&e1).cross(&arm);
        out[4] = n.cross(&e2).cross(&arm);
        match self {
            Self::Circle(r) | Self::Ellipse(r, _) => {
                let y = Vector2::new(r.axis_a.dot(&arm) / r.a, r.axis_b.dot(&arm) / r.b);
                let direction = r.axis_a * y.x + r.axis_b * y.y;
                let (u, v) = (e1.dot(&direction), e2.dot(&direction));
                out[5] = e1 * u + e2 * v;
                if matches!(self, Self::Ellipse(..)) {
                    out[6] = e1 * u - e2 * v;
                    out[7] = e1 * v + e2 * u;
                }
            }
            Self::Bar(t, _) => {
                let along = arm - n * n.dot(&arm);
                let e = along.try_normalize(0.0).unwrap_or(e1);
                out[5] = e;
                out[6] = arm - e * t.core;
            }
        }
        out
    }
}

/// An edge point relative to the outline of a shape.
#[derive(Clone, Copy, Debug)]
pub(super) struct OutlinePoint {
    /// Distance from the outline, pixels, positive outside.
    pub(super) residual: f64,
    /// Gradient direction of the distance in the image.
    pub(super) gradient: Vector2<f64>,
    /// The point of the shape that the outline shows there.
    pub(super) foot: Vector3<f64>,
}

impl OutlinePoint {
    /// Change of the residual when the shown point moves: the outline moves under the edge point.
    pub(super) fn by_motion(&self, motion: &Vector3<f64>, p: &Projection) -> f64 {
        -self.seen(&(p.fixed_view::<3, 3>(0, 0) * motion), p)
    }

    /// Change of the residual when the camera's projection changes.
    pub(super) fn by_camera(&self, change: &Projection, p: &Projection) -> f64 {
        -self.seen(&(change * self.foot.push(1.0)), p)
    }

    /// Change of the shown point's homogeneous image along the gradient, pixels.
    fn seen(&self, d: &Vector3<f64>, p: &Projection) -> f64 {
        let h = p * self.foot.push(1.0);
        self.gradient.dot(&(d.xy() - h.xy() * (d.z / h.z))) / h.z
    }
}

/// The axes of a plane, transported when its normal turns.
fn turned_frame(f: &Matrix3<f64>, normal: &Vector3<f64>) -> Option<[Vector3<f64>; 2]> {
    let e1 = f.column(0).into_owned();
    let e1 = (e1 - normal * normal.dot(&e1)).try_normalize(1e-6)?;
    Some([e1, normal.cross(&e1)])
}

/// Symmetric matrix of a rim's semi-axes in the axes of `frame_of` its normal.
fn shape_matrix(r: &Rim) -> Matrix2<f64> {
    let f = frame_of(&r.normal);
    let a = Vector2::new(r.axis_a.dot(&f.column(0)), r.axis_a.dot(&f.column(1)));
    let b = Vector2::new(-a.y, a.x);
    (a * a.transpose() * r.a + b * b.transpose() * r.b) / a.norm_squared().max(1e-12)
}

fn rim_of(centre: Vector3<f64>, normal: Vector3<f64>, g: &[Vector3<f64>; 2], s: &Matrix2<f64>) -> Option<Rim> {
    let eigen = s.symmetric_eigen();
    let (big, small) = if eigen.eigenvalues[0] >= eigen.eigenvalues[1] { (0, 1) } else { (1, 0) };
    let v = eigen.eigenvectors.column(big);
    let axis_a = signed_axis(g[0] * v[0] + g[1] * v[1]);
    let (a, b) = (eigen.eigenvalues[big], eigen.eigenvalues[small]);
    (b > 0.0 && a.is_finite()).then(|| Rim { centre, normal, a, b, axis_a, axis_b: normal.cross(&axis_a) })
}

/// Maps the unit circle to a rim's image.
fn homography(p: &Projection, r: &Rim) -> Matrix3<f64> {
    let m = p.fixed_view::<3, 3>(0, 0);
    Matrix3::from_columns(&[m * r.axis_a * r.a, m * r.axis_b * r.b, m * r.centre + p.column(3)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::offline::rim::synthetic::{rig, rim_points, rim_tilted};
    use crate::offline::types::Outline;

    /// Edge points slightly off the outline of an ellipse that is near every shape of the test.
    fn near(p: &Projection) -> Vec<EdgePoint> {
        let other = rim_tilted(Vector3::new(0.02, -0.05, 1.5), 0.5, 1.0, 0.0805, 0.0798);
        let at = |uv: Vector2<f64>| EdgePoint { uv: uv + Vector2::new(0.2, -0.1), sigma: 0.1, outline: Outline::Outer };
        rim_points(p, &other, 60).into_iter().map(at).collect()
    }

    /// Slopes of all residuals by central differences.
    fn slopes(residuals: impl Fn(f64) -> Vec<f64>, h: f64) -> Vec<f64> {
        residuals(h).iter().zip(residuals(-h)).map(|(a, b)| (a - b) / (2.0 * h)).collect()
    }

    fn assert_close(analytic: impl Iterator<Item = f64>, numeric: &[f64], what: &str) {
        let largest = numeric.iter().fold(0.0f64, |m, s| m.max(s.abs()));
        assert!(largest > 0.0, "{what} moves nothing");
        for (a, n) in analytic.zip(numeric) {
            // For edges off the outline the slope differs by their distance over its radius of curvature.
            assert!((a - n).abs() < 0.03 * largest, "{what}: {a} against {n}");
        }
    }

    #[test]
    fn derivatives_agree_with_finite_differences() {
        let rim = rim_tilted(Vector3::new(0.02, -0.05, 1.5), 0.5, 1.0, 0.08, 0.0797);
        let round = Rim { b: rim.a, ..rim };
        let torus = Torus { centre: rim.centre, normal: rim.normal, core: 0.07, bar: 0.01 };
        for shape in [Shape::Circle(round), Shape::Ellipse(rim, 0.25), Shape::Bar(torus, None)] {
            for p in rig(0.5, 1200.0, 1.5) {
                let points = near(&p);
                let here = shape.outline_points(&points, &p).unwrap();
                let residuals = |s: &Shape, p: &Projection| -> Vec<f64> {
                    s.outline_points(&points, p).unwrap().iter().map(|point| point.residual).collect()
                };
                for k in 0..shape.parameters() {
                    let moved = |by: f64| {
                        let d = std::array::from_fn(|i| if i == k { by } else { 0.0 });
                        residuals(&shape.moved(&d).unwrap(), &p)
                    };
                    let own = here.iter().map(|point| point.by_motion(&shape.motions(&point.foot)[k], &p));
                    assert_close(own, &slopes(moved, 1e-6), &format!("{shape:?}, parameter {k}"));
                }
                let mut change = Projection::zeros();
                change.set_row(0, &(p.row(2) * 2.0));
                change.set_row(1, &(p.row(0) * 1e-3));
                let own = here.iter().map(|point| point.by_camera(&change, &p));
                assert_close(
                    own,
                    &slopes(|by| residuals(&shape, &(p + change * by)), 1e-3),
                    &format!("{shape:?}, camera"),
                );
            }
        }
    }
}
