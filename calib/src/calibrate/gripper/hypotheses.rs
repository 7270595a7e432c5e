//! Selects the error model of rig and marks by Bayesian evidence.
//!
//! A rig without a stated covariance is either practically exact or has errors of some multiple of the standard
//! deviations of a careful calibration. Marks that are stated as exact may or may not be exact. Each combination is a
//! hypothesis with its own likelihood. Degrees of freedom that the data do not need cost evidence (the volume of the
//! prior relative to that of the posterior), so no threshold is needed.

use super::bundle::{Model, State};
use super::data::{Noise, Recording, Sigma};
use super::error::GripperError;
use super::rig_prior::{RigDeviations, RigPrior};
use super::solve::{Fit, first_scales, fit};
use graspd_rt::geom::Pose;
use nalgebra::DVector;

/// Multiples of the default standard deviations that are tried for a rig without a stated covariance. Steps of a factor
/// of three lose at most half a unit of log-evidence per direction compared with the best multiple.
const RIG_SCALES: [f64; 5] = [0.0, 0.3, 1.0, 3.0, 10.0];
/// Maximum difference of log-evidence that is negligible ("not worth more than a bare mention", Jeffreys). Of two rig
/// scales this close the larger one is used: too narrow a prior makes the covariance overconfident, too wide a one
/// costs almost nothing.
const MAX_NEGLIGIBLE_EVIDENCE: f64 = 1.0;
/// Initial standard deviation of marks stated as exact in the hypothesis that they are not, metres; it is estimated.
const INEXACT_MARKS_M: f64 = 3e-4;

/// Assumptions of a fit.
#[derive(Clone, Debug, PartialEq)]
pub struct Hypothesis {
    /// Multiple of the rig's standard deviations; 0 for an exact rig.
    pub rig_scale: f64,
    /// Whether the rig's covariance is stated.
    pub rig_stated: bool,
    /// Whether the marks are unknowns.
    pub free_marks: bool,
    /// Logarithm of the evidence, up to a constant that depends only on the recording.
    pub evidence: f64,
}

/// The hypothesis with the largest evidence, its fit, and all hypotheses that were fitted.
pub(super) struct Chosen<'a> {
    pub(super) model: Model<'a>,
    pub(super) fit: Fit,
    pub(super) tried: Vec<Hypothesis>,
    pub(super) best: usize,
    scale: f64,
}

/// Fits every hypothesis from the closed-form initial estimate (`flange`: initial flange corrections) and selects the
/// one with the largest evidence.
///
/// # Errors
/// No fit converges.
pub(super) fn choose<'a>(rec: &'a Recording, x: Pose, y: Pose, flange: Vec<Pose>) -> Result<Chosen<'a>, GripperError> {
    let exact = rec.noise.marks_m.value == 0.0;
    let unit = match &rec.rig_prior {
        Some(stated) => stated.clone(),
        None => RigPrior::from_deviations(&RigDeviations::default(), &rec.rig),
    };
    let ladder: &[f64] = if rec.rig_prior.is_some() { &[1.0] } else { &RIG_SCALES };
    let freed = Noise { marks_m: Sigma { value: INEXACT_MARKS_M, stated: false }, ..rec.noise };
    let marks: &[(bool, Noise)] = if exact { &[(false, rec.noise), (true, freed)] } else { &[(true, rec.noise)] };
    let start = State { x, y, marks: rec.marks.clone(), flange, u: DVector::zeros(0) };
    let (mut tried, mut best, mut failed): (Vec<Hypothesis>, Option<(usize, Chosen<'a>)>, _) = (Vec::new(), None, None);
    for (free_marks, noise) in marks {
        let mut fallen = 0;
        let mut last = f64::NEG_INFINITY;
        for &rig_scale in ladder {
            // The evidence has one maximum over the scales: stop after two decreases.
            if fallen == 2 {
                break;
            }
            let model = Model::new(rec, unit.scaled(rig_scale), *free_marks);
            let from = State { u: DVector::zeros(model.prior.unknowns()), ..start.clone() };
            let fit = match fit(&model, from, noise, first_scales(noise), true) {
                Ok(fit) => fit,
                Err(e) => {
                    failed = Some(e);
                    continue;
                }
            };
            let evidence = fit.evidence;
            fallen = if evidence < last { fallen + 1 } else { 0 };
            last = evidence;
            let rig_stated = rec.rig_prior.is_some();
            tried.push(Hypothesis { rig_scale, rig_stated, free_marks: *free_marks, evidence });
            // Scales are in ascending order. A larger one is rejected only if its evidence is clearly lower.
            let wider = best.as_ref().is_some_and(|(_, b)| b.model.free_marks == *free_marks && b.scale > 0.0);
            let margin = if wider { MAX_NEGLIGIBLE_EVIDENCE } else { 0.0 };
            if best.as_ref().is_none_or(|(_, b)| evidence > b.fit.evidence - margin) {
                best = Some((tried.len() - 1, Chosen { model, fit, tried: Vec::new(), best: 0, scale: rig_scale }));
            }
        }
    }
    match best {
        Some((at, chosen)) => Ok(Chosen { tried, best: at, ..chosen }),
        None => Err(failed.unwrap_or_else(|| GripperError::NotConverged("no hypothesis was fitted".into()))),
    }
}
