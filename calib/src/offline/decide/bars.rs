//! A round bar against the other models of its four outlines.

use crate::offline::bar::found::BarFound;
use crate::offline::bar::torus::Torus;
use crate::offline::correspondence::rig_error::RigError;
use crate::offline::decide::likelihood::{Fitted, Hypothesis, Shape, Stretch, fit};
use crate::offline::decide::models::{Model, UNEVENNESS, Weighed, each_alone, prior, stretch, unrelated_px};
use crate::offline::rim::model::{Options, RimModel};
use crate::offline::rim::planar::{Analysis, analyse};
use crate::offline::types::Outline;

/// Relative standard deviation of a bar radius that the operator gave: callipers on a painted bar are accurate to one
/// percent.
const KNOWN_RADIUS_SIGMA: f64 = 0.01;

/// The bar's radius and its relative standard deviation, where the operator gave its diameter.
pub(in crate::offline) fn known_radius(options: &Options) -> Option<(f64, f64)> {
    options.bar_diameter.map(|d| (0.5 * d, KNOWN_RADIUS_SIGMA))
}

/// A bar's four outlines with the models that explain them.
#[derive(Clone, Debug)]
pub(in crate::offline) struct FourOutlines {
    /// The outlines and the bar fitted to them.
    pub(in crate::offline) found: BarFound,
    /// The outlines' points.
    pub(in crate::offline) stretches: Vec<Stretch>,
    /// The plane analysis of the outer outlines.
    pub(in crate::offline) outer: Analysis,
    /// The bar, a flat ring with two edges, and unrelated contours, each with its evidence.
    pub(in crate::offline) models: Vec<Weighed>,
}

impl FourOutlines {
    /// Weighs the models of a bar that was found. `None` where the outer outlines cannot be analysed.
    pub(in crate::offline) fn new(found: BarFound, rig: &RigError, options: &Options) -> Option<Self> {
        let p = [&rig.p[0], &rig.p[1]];
        let stretches: Vec<Stretch> = [0, 1]
            .into_iter()
            .flat_map(|k| {
                [stretch(k, &found.outer[k], Outline::Outer, 0), stretch(k, &found.inner[k], Outline::Inner, 0)]
            })
            .collect();
        // On a flat ring the inner outline is a second rim.
        let apart: Vec<Stretch> =
            stretches.iter().enumerate().map(|(n, s)| Stretch { shape: n % 2, ..s.clone() }).collect();
        let plain = |n: usize| -> Vec<_> {
            let points = apart.get(n).map(|s| s.points.as_slice()).unwrap_or_default();
            points.iter().map(|q| crate::offline::types::EdgePoint { outline: Outline::Outer, ..*q }).collect()
        };
        let lenient = Options { robust: true, ..*options };
        let outer = analyse([&plain(0), &plain(2)], p, &lenient).ok()?;
        let inner = analyse([&plain(1), &plain(3)], p, &lenient);
        let mut models = Vec::new();
        let mut weigh = |model: Model, shapes: Vec<Shape>, unrelated_px: Option<f64>, s: &[Stretch], prior: f64| {
            if let Some(fitted) = fit(&Hypothesis { shapes, unrelated_px }, s, rig) {
                let log = fitted.log_evidence + prior.ln();
                models.push(Weighed { model, fitted, log });
            }
        };
        let r = &found.reconstruction;
        let torus =
            Torus { centre: r.rim.centre, normal: r.rim.normal, core: r.rim.a, bar: r.bar_radius.unwrap_or_default() };
        let bar = prior(Model::Bar, options.rim);
        weigh(Model::Bar, vec![Shape::Bar(torus, known_radius(options))], None, &stretches, bar);
        if let Ok(inner) = &inner {
            let pick = |a: &Analysis, model| match model {
                RimModel::Circle => a.circle.as_ref().ok().map(|f| Shape::Circle(f.rim)),
                _ => a.ellipse.as_ref().ok().map(|f| Shape::Ellipse(f.rim, UNEVENNESS)),
            };
            let px = unrelated_px([&found.outer[0], &found.outer[1]]);
            for (model, kind, unrelated) in [
                (Model::Circle, RimModel::Circle, None),
                (Model::Ellipse, RimModel::Ellipse, None),
                (Model::Unrelated, RimModel::Ellipse, Some(px)),
            ] {
                if let (Some(a), Some(b)) = (pick(&outer, kind), pick(inner, kind)) {
                    weigh(model, vec![a, b], unrelated, &apart, prior(model, options.rim).min(1.0 - 0.5 * bar));
                }
            }
        }
        let ellipses = [&found.outer[0], &found.inner[0], &found.outer[1], &found.inner[1]].map(|c| &c.ellipse);
        models.extend(each_alone(&stretches, &ellipses, options.rim, rig));
        Some(Self { found, stretches, outer, models })
    }

    /// The fitted bar.
    pub(in crate::offline) fn bar(&self) -> Option<&Fitted> {
        self.models.iter().find(|m| m.model == Model::Bar).map(|m| &m.fitted)
    }

    /// Log odds of the bar against every other model.
    pub(in crate::offline) fn log_odds(&self) -> f64 {
        let best = |bar: bool| {
            let logs = self.models.iter().filter(|m| (m.model == Model::Bar) == bar).map(|m| m.log);
            logs.fold(f64::NEG_INFINITY, f64::max)
        };
        match (best(true), best(false)) {
            (b, _) if b == f64::NEG_INFINITY => f64::NEG_INFINITY,
            // Without an alternative there is no evidence.
            (_, f) if f == f64::NEG_INFINITY => 0.0,
            (b, f) => b - f,
        }
    }
}
