//! Two contours weighed as images of one plane rim.

use crate::offline::contour::{Contour, ViewEdges, separate_pair};
use crate::offline::correspondence::rig_error::RigError;
use crate::offline::decide::models::{Model, Weighed, plane_models, probabilities};
use crate::offline::rim::model::{Options, RimModel, Score};
use crate::offline::rim::planar::{Analysis, analyse};
use crate::offline::rim::refusal::Refusal;
use crate::offline::types::Outline;

/// Scale of the exponential distribution of a click's distance from the contour, pixels.
const CLICK_SCALE_PX: f64 = 2.0;

/// Two contours with their plane models.
pub(super) struct Judged {
    pub(super) contours: [Contour; 2],
    pub(super) analysis: Analysis,
    pub(super) models: Vec<Weighed>,
    pub(super) score: f64,
    pub(super) cost: f64,
    pub(super) tried: usize,
}

impl Judged {
    pub(super) fn probability(&self, model: Model) -> f64 {
        let p = probabilities(&self.models.iter().map(|m| m.log).collect::<Vec<_>>());
        self.models.iter().zip(p).filter(|(m, _)| m.model == model).map(|(_, p)| p).sum()
    }

    /// Probability that the contours are one plane rim.
    pub(super) fn rim(&self) -> f64 {
        // Without an alternative there is no evidence.
        if !self.models.iter().any(|m| m.model == Model::Unrelated) {
            return 0.0;
        }
        self.probability(Model::Circle) + self.probability(Model::NearlyRound) + self.probability(Model::Ellipse)
    }

    pub(super) fn best(&self) -> Option<&Weighed> {
        let plane = self.models.iter().filter(|m| matches!(m.model, Model::Circle | Model::Ellipse));
        plane.max_by(|a, b| a.log.total_cmp(&b.log))
    }

    /// Log evidence of the best plane model.
    pub(super) fn log_rim(&self) -> f64 {
        self.best().map_or(f64::NEG_INFINITY, |b| b.log)
    }

    pub(super) fn scores(&self) -> Vec<Score> {
        let model = |m: Model| match m {
            Model::Circle => Some(RimModel::Circle),
            Model::Ellipse => Some(RimModel::Ellipse),
            _ => None,
        };
        self.models.iter().filter_map(|m| Some(score(model(m.model)?, m))).collect()
    }

    pub(super) fn refusal(&self, rig: &RigError) -> Refusal {
        if self.probability(Model::Opposite) > 0.5 {
            return Refusal::OppositeSides {
                why: "the plane between the cameras carries a circle, the plane in front of them does not",
            };
        }
        Refusal::Different { gap_px: self.analysis.gap_px, probability: 1.0 - self.rim(), rig_px: rig.unknown_px() }
    }
}

pub(super) fn score(model: RimModel, m: &Weighed) -> Score {
    let f = &m.fitted;
    Score { model, chi2: f.chi2, parameters: f.parameters, bic: -2.0 * m.log, excluded: None }
}

pub(super) fn judge(
    views: [&ViewEdges<'_>; 2],
    clicked: [&Contour; 2],
    (cost, tried): (f64, usize),
    rig: &RigError,
    options: &Options,
) -> Result<Judged, Refusal> {
    let contours = separate_pair(views, clicked);
    let points = [0, 1].map(|k| contours[k].edge_points(Outline::Outer));
    let analysis = analyse([&points[0], &points[1]], [&rig.p[0], &rig.p[1]], options)?;
    let models = plane_models([&contours[0], &contours[1]], &analysis, options.rim, rig);
    let mut out = Judged { contours, analysis, models, score: 0.0, cost, tried };
    if out.best().is_none() {
        return Err(out.analysis.no_rim());
    }
    out.score = -cost / CLICK_SCALE_PX + out.rim().max(f64::MIN_POSITIVE).ln();
    Ok(out)
}
