//! The models that are compared for two contours, each with its evidence.

use crate::offline::bar::torus::Torus;
use crate::offline::contour::Contour;
use crate::offline::correspondence::rig_error::RigError;
use crate::offline::decide::likelihood::{Fitted, Hypothesis, Shape, Stretch, fit};
use crate::offline::rim::circle::signed_axis;
use crate::offline::rim::model::{Rim, RimChoice};
use crate::offline::rim::planar::Analysis;
use crate::offline::types::projection::Projection;
use crate::offline::types::projection::{camera_centre, ray};
use crate::offline::types::{Ellipse2, Outline};
use nalgebra::Vector2;

/// A model of some contours.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::offline) enum Model {
    /// A plane circle.
    Circle,
    /// A plane ellipse.
    Ellipse,
    /// A plane rim that is meant to be round and is not quite.
    NearlyRound,
    /// A round bar.
    Bar,
    /// Two contours that have nothing to do with each other.
    Unrelated,
    /// A circle of which the cameras see opposite faces.
    Opposite,
}

/// A model with its evidence and prior.
#[derive(Clone, Debug)]
pub(in crate::offline) struct Weighed {
    /// The model.
    pub(in crate::offline) model: Model,
    /// At its optimum.
    pub(in crate::offline) fitted: Fitted,
    /// Logarithm of evidence times prior probability.
    pub(in crate::offline) log: f64,
}

/// Prior probabilities. They matter little: a model that is right cycles the others by tens of units of the logarithm,
/// and what does not is asked about.
///
/// A hand chooses the same contour in both images, and the contours offered to it include its neighbours; rims are
/// circles more often than ellipses.
const UNRELATED: f64 = 0.2;
const OPPOSITE: f64 = 0.01;
const ELLIPSE: f64 = 0.15;
const CIRCLE: f64 = 1.0 - UNRELATED - OPPOSITE - ELLIPSE;
/// Probability of what the operator has said is something else.
const MISNAMED: f64 = 1e-3;

/// Part of the round rims that are round to a hundredth only: bent, worn, or made so.
const NEARLY: f64 = 0.2;
/// How far an ellipse, and how far a rim that is meant to be round, is from round (see [`Shape::Ellipse`]).
pub(in crate::offline) const UNEVEN: f64 = 0.25;
const NEARLY_UNEVEN: f64 = 0.01;

/// How far unrelated contours lie from each other, as a fraction of their semi-major axis.
const UNRELATED_PART: f64 = 0.4;

/// Prior probability of a plane model under the operator's words.
pub(in crate::offline) fn prior(model: Model, choice: RimChoice) -> f64 {
    match (model, choice) {
        (Model::Unrelated, _) => UNRELATED,
        (Model::Opposite, _) => OPPOSITE,
        (Model::Circle, RimChoice::Ellipse) | (Model::Ellipse, RimChoice::Circle) => MISNAMED * CIRCLE,
        (Model::NearlyRound, RimChoice::Circle | RimChoice::Ellipse) => MISNAMED * CIRCLE,
        (Model::NearlyRound, _) => NEARLY * CIRCLE,
        (Model::Circle, _) => (1.0 - NEARLY) * CIRCLE,
        (Model::Ellipse, RimChoice::Ellipse) => CIRCLE,
        (Model::Ellipse, _) => ELLIPSE,
        (Model::Bar, RimChoice::RoundBar) => 1.0 - MISNAMED,
        (Model::Bar, RimChoice::Auto) => 0.5,
        (Model::Bar, _) => MISNAMED,
    }
}

/// The stretch of a contour.
pub(in crate::offline) fn stretch(view: usize, c: &Contour, outline: Outline, shape: usize) -> Stretch {
    Stretch { view, points: c.edge_points(outline), place: c.points.iter().map(|p| p.parameter).collect(), shape }
}

/// How far apart unrelated contours are, pixels.
pub(in crate::offline) fn unrelated_px(contours: [&Contour; 2]) -> f64 {
    UNRELATED_PART * contours[0].ellipse.a.min(contours[1].ellipse.a)
}

/// Plane models of two contours, and the alternative that they are unrelated. Empty where no plane carries them.
pub(in crate::offline) fn plane_models(
    contours: [&Contour; 2],
    a: &Analysis,
    choice: RimChoice,
    rig: &RigError,
) -> Vec<Weighed> {
    let stretches = [0, 1].map(|k| stretch(k, contours[k], Outline::Outer, 0));
    let mut out = Vec::new();
    let mut weigh = |model: Model, shape: Shape, unrelated_px: Option<f64>| {
        if let Some(fitted) = fit(&Hypothesis { shapes: vec![shape], unrelated_px }, &stretches, rig) {
            let log = fitted.log_evidence + prior(model, choice).ln();
            out.push(Weighed { model, fitted, log });
        }
    };
    let round = |r: &Rim| {
        let size = (r.a * r.b).sqrt();
        Rim { a: size, b: size, ..*r }
    };
    let circle = a.circle.as_ref().ok().map(|f| f.rim);
    let ellipse = a.ellipse.as_ref().ok().map(|f| f.rim);
    if let Some(start) = circle.or(ellipse.map(|r| round(&r))) {
        weigh(Model::Circle, Shape::Circle(start), None);
    }
    if let Some(start) = ellipse.or(circle) {
        weigh(Model::Ellipse, Shape::Ellipse(start, UNEVEN), None);
        weigh(Model::NearlyRound, Shape::Ellipse(start, NEARLY_UNEVEN), None);
        weigh(Model::Unrelated, Shape::Ellipse(start, UNEVEN), Some(unrelated_px(contours)));
    }
    if let Some((start, _)) = a.between {
        weigh(Model::Opposite, Shape::Circle(start), None);
    }
    let ellipses = [&contours[0].ellipse, &contours[1].ellipse];
    out.extend(each_alone(&stretches, &ellipses, choice, rig));
    out
}

/// Contours that have nothing to do with each other, each as an ellipse of its own image.
///
/// [`Hypothesis::unrelated_px`] starts from a rim, and says nothing where contours are so far from one that it leads nowhere. An ellipse of
/// one image always fits, so that whatever is held against it has to fit the edges as well. Its size and place in space
/// cannot be seen, and cost as much as their prior is wide.
pub(in crate::offline) fn each_alone(
    stretches: &[Stretch],
    ellipses: &[&Ellipse2],
    choice: RimChoice,
    rig: &RigError,
) -> Option<Weighed> {
    let believed = rig.held(rig.given());
    let mut all: Option<Fitted> = None;
    for (s, e) in stretches.iter().zip(ellipses) {
        let shapes = vec![Shape::Ellipse(facing(e, believed.p.get(s.view)?)?, UNEVEN)];
        let own = [Stretch { shape: 0, ..s.clone() }];
        let fitted = fit(&Hypothesis { shapes, unrelated_px: None }, &own, &believed)?;
        all = Some(match all {
            None => fitted,
            Some(f) => Fitted { log_evidence: f.log_evidence + fitted.log_evidence, ..f },
        });
    }
    let fitted = all?;
    let log = fitted.log_evidence + prior(Model::Unrelated, choice).ln();
    Some(Weighed { model: Model::Unrelated, fitted, log })
}

/// The rim parallel to a camera's image, a metre before it, that looks like an ellipse there.
fn facing(e: &Ellipse2, p: &Projection) -> Option<Rim> {
    let back = p.fixed_view::<3, 3>(0, 0).into_owned().try_inverse()?;
    let (sin, cos) = e.theta.sin_cos();
    let ahead = back * e.centre.push(1.0);
    // Of unit length along the ray; turned to the front by `ray`.
    let reach = ray(p, e.centre.x, e.centre.y)?.dot(&ahead).recip();
    let (major, minor) = (Vector2::new(cos, sin) * e.a, Vector2::new(-sin, cos) * e.b);
    let (u, v) = (back * major.push(0.0) * reach, back * minor.push(0.0) * reach);
    let normal = (-u.cross(&v)).try_normalize(0.0)?;
    let axis_a = signed_axis(u.try_normalize(0.0)?);
    let centre = camera_centre(p)? + ahead * reach;
    Some(Rim { centre, normal, a: u.norm(), b: v.norm(), axis_a, axis_b: normal.cross(&axis_a) })
}

/// A bar of which two contours would be the outer outlines, and nothing else is seen.
pub(in crate::offline) fn bar_alone(
    contours: [&Contour; 2],
    start: Torus,
    known: Option<(f64, f64)>,
    rig: &RigError,
) -> Option<Fitted> {
    let stretches = [0, 1].map(|k| stretch(k, contours[k], Outline::Outer, 0));
    fit(&Hypothesis { shapes: vec![Shape::Bar(start, known)], unrelated_px: None }, &stretches, rig)
}

/// Probabilities of weighed models.
pub(in crate::offline) fn probabilities(logs: &[f64]) -> Vec<f64> {
    let most = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let each: Vec<f64> = logs.iter().map(|l| (l - most).exp()).collect();
    let sum: f64 = each.iter().sum();
    each.into_iter().map(|e| e / sum).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::offline::conic::{ellipse_of, orient};
    use crate::offline::rim::synthetic::{rig, rim_point, rim_points, rim_tilted};
    use crate::offline::types::EdgePoint;
    use crate::offline::types::projection::project;
    use graspd_rt::geom::{Camera, Distortion, Rig};
    use nalgebra::{Matrix3, Vector3};

    #[test]
    fn a_rim_parallel_to_the_image_looks_like_the_ellipse_it_was_made_for() {
        let e = Ellipse2 { centre: Vector2::new(700.0, 420.0), a: 90.0, b: 55.0, theta: 0.7 };
        for p in rig(0.5, 1200.0, 1.5) {
            let rim = facing(&e, &p).unwrap();
            for k in 0..12 {
                let uv = project(&p, &rim_point(&rim, f64::from(k) * 0.5)) - e.centre;
                let (sin, cos) = e.theta.sin_cos();
                let (x, y) = ((uv.x * cos + uv.y * sin) / e.a, (uv.y * cos - uv.x * sin) / e.b);
                assert!((x.hypot(y) - 1.0).abs() < 1e-9, "{x} {y}");
            }
        }
    }

    /// Evidence of two contours as one rim against each as an ellipse of its own image; the right one is higher over the epipolar lines by
    /// a factor, about its middle.
    fn odds(higher: f64) -> f64 {
        let camera = Camera {
            fx: 1200.0,
            fy: 1200.0,
            cx: 640.0,
            cy: 512.0,
            width: 1280,
            height: 1024,
            distortion: Distortion::default(),
        };
        let mut right_from_left = graspd_rt::geom::Pose::identity();
        right_from_left.translation.vector.x = -0.3;
        let rig = RigError::exact(&Rig { left: camera, right: camera, right_from_left });
        let rim = rim_tilted(Vector3::new(0.1, 0.02, 1.2), 0.5, 1.0, 0.08, 0.08);
        let views = [0, 1].map(|k| {
            let middle = project(&rig.p[k], &rim.centre);
            let stretched = |uv: Vector2<f64>| {
                let up = if k == 1 { higher } else { 1.0 };
                Vector2::new(uv.x, middle.y + (uv.y - middle.y) * up)
            };
            rim_points(&rig.p[k], &rim, 120).into_iter().map(stretched).collect::<Vec<_>>()
        });
        let stretches = [0, 1].map(|view| Stretch {
            view,
            points: views[view].iter().map(|uv| EdgePoint { uv: *uv, sigma: 0.1, outline: Outline::Outer }).collect(),
            place: (0..120).map(|k| f64::from(k) * std::f64::consts::TAU / 120.0).collect(),
            shape: 0,
        });
        let ellipses = views.each_ref().map(|v| ellipse_through(v));
        let alone = each_alone(&stretches, &[&ellipses[0], &ellipses[1]], RimChoice::Auto, &rig).unwrap();
        let shapes = vec![Shape::Ellipse(rim, UNEVEN)];
        let one = fit(&Hypothesis { shapes, unrelated_px: None }, &stretches, &rig);
        one.map_or(f64::NEG_INFINITY, |f| f.log_evidence) + prior(Model::Ellipse, RimChoice::Auto).ln() - alone.log
    }

    /// The ellipse through points on one.
    fn ellipse_through(points: &[Vector2<f64>]) -> Ellipse2 {
        let edges: Vec<_> =
            points.iter().map(|uv| EdgePoint { uv: *uv, sigma: 0.1, outline: Outline::Outer }).collect();
        let conic: Matrix3<f64> = crate::offline::conic::fit_direct(&edges).unwrap();
        ellipse_of(&orient(&conic)).unwrap()
    }

    #[test]
    fn one_rim_is_held_against_an_ellipse_in_each_image_on_both_sides() {
        let (same, other) = (odds(1.0), odds(1.1));
        assert!(same > -MISNAMED.ln(), "one rim: {same}");
        assert!(other < MISNAMED.ln(), "no rim has both: {other}");
    }
}
