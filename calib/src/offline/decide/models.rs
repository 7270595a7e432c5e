//! The models that are compared for two contours, each with its evidence.

use crate::offline::bar::torus::Torus;
use crate::offline::contour::Contour;
use crate::offline::correspondence::rig_error::RigError;
use crate::offline::decide::likelihood::{Fitted, Hypothesis, Shape, Stretch, fit};
use crate::offline::rim::model::{Outline, Rim, RimChoice};
use crate::offline::rim::planar::Analysis;

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

/// Prior probabilities. They matter little: a model that is right beats the others by tens of units of the logarithm,
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
    out
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
