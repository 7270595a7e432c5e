//! What the recording leaves open about its own rig and marks, decided by the evidence.
//!
//! A rig whose file states no covariance is either as good as exact or off by some multiple of the deviations of a
//! careful calibration; marks that are stated as exact are so, or not. Each is a hypothesis with a likelihood of its
//! own, and freedom that the data do not ask for costs evidence (the prior's volume against the posterior's), so
//! nothing has to be gated.

use super::bundle::{Model, State};
use super::data::{Noise, Recording, Sigma};
use super::error::GripperError;
use super::rig_prior::{RigDeviations, RigPrior};
use super::solve::{Fit, first_scales, fit};
use graspd_rt::geom::Pose;
use nalgebra::DVector;

/// Multiples of the default deviations that a rig without a stated covariance is tried with; steps of three lose at
/// most half a unit of log-evidence a direction against the best multiple.
const LADDER: [f64; 5] = [0.0, 0.3, 1.0, 3.0, 10.0];
/// Difference of log-evidence that is not worth more than a bare mention (Jeffreys): between two scales of the rig that
/// are this close the wider one is used, since too narrow a prior makes the covariance a lie, and too wide a one costs
/// next to nothing.
const BARE_MENTION: f64 = 1.0;
/// Marks that were stated as exact are tried with this deviation, metres, to be estimated.
const NOT_EXACT: f64 = 3e-4;

/// What a fit was made under.
#[derive(Clone, Debug, PartialEq)]
pub struct Hypothesis {
    /// Multiple of the rig's deviations; 0 for an exact rig.
    pub rig_scale: f64,
    /// Whether the rig's deviations were stated.
    pub rig_stated: bool,
    /// Whether the marks are unknowns.
    pub free_marks: bool,
    /// Logarithm of the evidence, up to a constant of the recording.
    pub evidence: f64,
}

/// The likeliest hypothesis with its fit, and all that were tried.
pub(super) struct Chosen<'a> {
    pub(super) model: Model<'a>,
    pub(super) fit: Fit,
    pub(super) tried: Vec<Hypothesis>,
    pub(super) best: usize,
    scale: f64,
}

/// Fits every hypothesis from a start in closed form (`flange`: first flange corrections) and keeps the likeliest.
///
/// # Errors
/// When none comes to rest.
pub(super) fn choose<'a>(rec: &'a Recording, x: Pose, y: Pose, flange: Vec<Pose>) -> Result<Chosen<'a>, GripperError> {
    let exact = rec.noise.marks_m.value == 0.0;
    let unit = match &rec.rig_prior {
        Some(stated) => stated.clone(),
        None => RigPrior::from_deviations(&RigDeviations::default(), &rec.rig),
    };
    let ladder: &[f64] = if rec.rig_prior.is_some() { &[1.0] } else { &LADDER };
    let freed = Noise { marks_m: Sigma { value: NOT_EXACT, stated: false }, ..rec.noise };
    let marks: &[(bool, Noise)] = if exact { &[(false, rec.noise), (true, freed)] } else { &[(true, rec.noise)] };
    let start = State { x, y, marks: rec.marks.clone(), flange, u: DVector::zeros(0) };
    let (mut tried, mut best, mut failed): (Vec<Hypothesis>, Option<(usize, Chosen<'a>)>, _) = (Vec::new(), None, None);
    for (free_marks, noise) in marks {
        let mut fallen = 0;
        let mut last = f64::NEG_INFINITY;
        for &rig_scale in ladder {
            // Evidence has one maximum along the ladder: past it, two steps down are enough.
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
            // Along the ladder the wider rig comes later, and has to be clearly less likely to be passed over.
            let wider = best.as_ref().is_some_and(|(_, b)| b.model.free_marks == *free_marks && b.scale > 0.0);
            let margin = if wider { BARE_MENTION } else { 0.0 };
            if best.as_ref().is_none_or(|(_, b)| evidence > b.fit.evidence - margin) {
                best = Some((tried.len() - 1, Chosen { model, fit, tried: Vec::new(), best: 0, scale: rig_scale }));
            }
        }
    }
    match best {
        Some((at, chosen)) => Ok(Chosen { tried, best: at, ..chosen }),
        None => Err(failed.unwrap_or_else(|| GripperError::NotConverged("no hypothesis was tried".into()))),
    }
}
