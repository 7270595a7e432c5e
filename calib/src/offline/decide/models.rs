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
    /// A plane rim that is meant to be round and is not exactly.
    NearlyRound,
    /// A round bar.
    Bar,
    /// Two unrelated contours.
    Unrelated,
    /// A circle of which the cameras see opposite faces.
    Opposite,
}

/// A model with its evidence and prior.
#[derive(Clone, Debug)]
pub(in crate::offline) struct Weighed {
    /// The model.
    pub(in crate::offline) model: Model,
    /// The model at its optimum.
    pub(in crate::offline) fitted: Fitted,
    /// Logarithm of evidence times prior probability.
    pub(in crate::offline) log: f64,
}

/// Prior probability of unrelated contours: an operator selects the same contour in both images, but the candidates
/// include its neighbours.
///
/// The priors matter little: a correct model exceeds the others by tens of units of the log evidence, and the operator
/// is asked where it does not.
const P_UNRELATED: f64 = 0.2;
/// Prior probability that the cameras look at opposite faces.
const P_OPPOSITE: f64 = 0.01;
/// Prior probability of an ellipse: rims are circles more often.
const P_ELLIPSE: f64 = 0.15;
/// Prior probability of a circle.
const P_CIRCLE: f64 = 1.0 - P_UNRELATED - P_OPPOSITE - P_ELLIPSE;
/// Prior probability of a model that contradicts the operator.
const P_MISNAMED: f64 = 1e-3;
/// Fraction of the round rims that are round only to one percent: bent, worn, or made so.
const P_NEARLY_ROUND: f64 = 0.2;
/// Standard deviation of an ellipse from round (see [`Shape::Ellipse`]).
pub(in crate::offline) const UNEVENNESS: f64 = 0.25;
/// The same for a rim that is meant to be round.
const NEARLY_ROUND_UNEVENNESS: f64 = 0.01;

/// Standard deviation of the displacement between unrelated contours, as a fraction of their semi-major axis.
const UNRELATED_FRACTION: f64 = 0.4;

/// Prior probability of a model under the operator's choice.
pub(in crate::offline) fn prior(model: Model, choice: RimChoice) -> f64 {
    match (model, choice) {
        (Model::Unrelated, _) => P_UNRELATED,
        (Model::Opposite, _) => P_OPPOSITE,
        (Model::Circle, RimChoice::Ellipse) | (Model::Ellipse, RimChoice::Circle) => P_MISNAMED * P_CIRCLE,
        (Model::NearlyRound, RimChoice::Circle | RimChoice::Ellipse) => P_MISNAMED * P_CIRCLE,
        (Model::NearlyRound, _) => P_NEARLY_ROUND * P_CIRCLE,
        (Model::Circle, _) => (1.0 - P_NEARLY_ROUND) * P_CIRCLE,
        (Model::Ellipse, RimChoice::Ellipse) => P_CIRCLE,
        (Model::Ellipse, _) => P_ELLIPSE,
        (Model::Bar, RimChoice::RoundBar) => 1.0 - P_MISNAMED,
        (Model::Bar, RimChoice::Auto) => 0.5,
        (Model::Bar, _) => P_MISNAMED,
    }
}

/// A contour's points as input of the likelihood.
pub(in crate::offline) fn stretch(view: usize, c: &Contour, outline: Outline, shape: usize) -> Stretch {
    Stretch { view, points: c.edge_points(outline), parameter: c.points.iter().map(|p| p.parameter).collect(), shape }
}

/// Standard deviation of the displacement between unrelated contours, pixels.
pub(in crate::offline) fn unrelated_px(contours: [&Contour; 2]) -> f64 {
    UNRELATED_FRACTION * contours[0].ellipse.a.min(contours[1].ellipse.a)
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
        weigh(Model::Ellipse, Shape::Ellipse(start, UNEVENNESS), None);
        weigh(Model::NearlyRound, Shape::Ellipse(start, NEARLY_ROUND_UNEVENNESS), None);
        weigh(Model::Unrelated, Shape::Ellipse(start, UNEVENNESS), Some(unrelated_px(contours)));
    }
    if let Some((start, _)) = a.between {
        weigh(Model::Opposite, Shape::Circle(start), None);
    }
    let ellipses = [&contours[0].ellipse, &contours[1].ellipse];
    out.extend(each_alone(&stretches, &ellipses, choice, rig));
    out
}

/// Unrelated contours, each as an ellipse of its own image.
///
/// [`Hypothesis::unrelated_px`] starts from a rim, and has no solution for contours too far from one. An ellipse in
/// one image always fits, so that every alternative has to fit the edges as well. Its size and position in space are
/// unobservable, and cost the width of their prior.
pub(in crate::offline) fn each_alone(
    stretches: &[Stretch],
    ellipses: &[&Ellipse2],
    choice: RimChoice,
    rig: &RigError,
) -> Option<Weighed> {
    let given = rig.held(rig.given());
    let mut all: Option<Fitted> = None;
    for (s, e) in stretches.iter().zip(ellipses) {
        let shapes = vec![Shape::Ellipse(fronto_parallel(e, given.p.get(s.view)?)?, UNEVENNESS)];
        let own = [Stretch { shape: 0, ..s.clone() }];
        let fitted = fit(&Hypothesis { shapes, unrelated_px: None }, &own, &given)?;
        all = Some(match all {
            None => fitted,
            Some(f) => Fitted { log_evidence: f.log_evidence + fitted.log_evidence, ..f },
        });
    }
    let fitted = all?;
    let log = fitted.log_evidence + prior(Model::Unrelated, choice).ln();
    Some(Weighed { model: Model::Unrelated, fitted, log })
}

/// The rim parallel to a camera's image, one metre in front of it, that projects to an ellipse.
fn fronto_parallel(e: &Ellipse2, p: &Projection) -> Option<Rim> {
    let back = p.fixed_view::<3, 3>(0, 0).into_owned().try_inverse()?;
    let (sin, cos) = e.theta.sin_cos();
    let ahead = back * e.centre.push(1.0);
    // Distance one along the ray; `ray` points to the front.
    let reach = ray(p, e.centre.x, e.centre.y)?.dot(&ahead).recip();
    let (major, minor) = (Vector2::new(cos, sin) * e.a, Vector2::new(-sin, cos) * e.b);
    let (u, v) = (back * major.push(0.0) * reach, back * minor.push(0.0) * reach);
    let normal = (-u.cross(&v)).try_normalize(0.0)?;
    let axis_a = signed_axis(u.try_normalize(0.0)?);
    let centre = camera_centre(p)? + ahead * reach;
    Some(Rim { centre, normal, a: u.norm(), b: v.norm(), axis_a, axis_b: normal.cross(&axis_a) })
}

/// A bar with two contours as its outer outlines, when nothing else of it is visible.
pub(in crate::offline) fn bar_alone(
    contours: [&Contour; 2],
    start: Torus,
    known: Option<(f64, f64)>,
    rig: &RigError,
) -> Option<Fitted> {
    let stretches = [0, 1].map(|k| stretch(k, contours[k], Outline::Outer, 0));
    fit(&Hypothesis { shapes: vec![Shape::Bar(start, known)], unrelated_px: None }, &stretches, rig)
}

/// Normalised probabilities of log weights.
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
    fn a_fronto_parallel_rim_projects_to_its_ellipse() {
        let e = Ellipse2 { centre: Vector2::new(700.0, 420.0), a: 90.0, b: 55.0, theta: 0.7 };
        for p in rig(0.5, 1200.0, 1.5) {
            let rim = fronto_parallel(&e, &p).unwrap();
            for k in 0..12 {
                let uv = project(&p, &rim_point(&rim, f64::from(k) * 0.5)) - e.centre;
                let (sin, cos) = e.theta.sin_cos();
                let (x, y) = ((uv.x * cos + uv.y * sin) / e.a, (uv.y * cos - uv.x * sin) / e.b);
                assert!((x.hypot(y) - 1.0).abs() < 1e-9, "{x} {y}");
            }
        }
    }

    /// Log odds of one rim against an ellipse in each image. The right image is stretched across the epipolar lines
    /// about its middle by a factor.
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
            parameter: (0..120).map(|k| f64::from(k) * std::f64::consts::TAU / 120.0).collect(),
            shape: 0,
        });
        let ellipses = views.each_ref().map(|v| ellipse_through(v));
        let alone = each_alone(&stretches, &[&ellipses[0], &ellipses[1]], RimChoice::Auto, &rig).unwrap();
        let shapes = vec![Shape::Ellipse(rim, UNEVENNESS)];
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
    fn one_rim_wins_over_two_ellipses_only_if_it_fits() {
        let (same, other) = (odds(1.0), odds(1.1));
        assert!(same > -P_MISNAMED.ln(), "one rim: {same}");
        assert!(other < P_MISNAMED.ln(), "two contours: {other}");
    }
}
