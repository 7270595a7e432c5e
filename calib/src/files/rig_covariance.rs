//! The joint covariance of a rig's parameters in `rig.toml`.

use super::error::{FileError, Source};
use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

/// Covariance of the calibrated parameters, stored as standard deviations and correlations for readability.
///
/// Parameter names are those of `rig.toml` ("left.fx", "right.k1"). "right_from_left.x .. rz" is a small motion of the
/// right camera in its own frame (metres, radians): x_right = exp(twist) right_from_left x_left.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RigCovariance {
    /// Parameter name of each row.
    pub parameters: Vec<String>,
    /// Standard deviations, each in the unit of its parameter.
    pub sigma: Vec<f64>,
    /// Correlations: lower triangle by rows without the diagonal, so that the first row is empty.
    pub correlation: Vec<Vec<f64>>,
}

impl RigCovariance {
    /// From a covariance matrix with one parameter name per row.
    pub fn of(names: &[&str], covariance: &DMatrix<f64>) -> Self {
        let sigma: Vec<f64> = (0..names.len()).map(|k| covariance[(k, k)].max(0.0).sqrt()).collect();
        // Six digits of a correlation are more than any use of it needs, and keep the file readable.
        let round = |v: f64| (v * 1e6).round() / 1e6 + 0.0;
        let correlation = (0..names.len())
            .map(|i| {
                (0..i)
                    .map(|j| {
                        let s = sigma[i] * sigma[j];
                        if s > 0.0 { round(covariance[(i, j)] / s) } else { 0.0 }
                    })
                    .collect()
            })
            .collect();
        Self { parameters: names.iter().map(|n| (*n).to_owned()).collect(), sigma, correlation }
    }

    /// The covariance matrix.
    pub fn matrix(&self) -> DMatrix<f64> {
        let n = self.sigma.len();
        DMatrix::from_fn(n, n, |i, j| {
            let (a, b) = (i.max(j), i.min(j));
            let r = if i == j { 1.0 } else { self.correlation.get(a).and_then(|r| r.get(b)).copied().unwrap_or(0.0) };
            r * self.sigma[i] * self.sigma[j]
        })
    }

    /// Checks sizes and value ranges.
    pub(super) fn check(&self, src: &Source<'_>) -> Result<(), FileError> {
        let n = self.parameters.len();
        let shape = self.sigma.len() == n
            && self.correlation.len() == n
            && self.correlation.iter().enumerate().all(|(k, row)| row.len() == k);
        if !shape {
            return Err(src.refuse(
                "covariance.correlation",
                format!("{} parameters, {} sigmas, {} rows", n, self.sigma.len(), self.correlation.len()),
                "parameters, sigma and correlation differ in size",
                "keep the table as graspd calibrate wrote it, or remove it",
            ));
        }
        if let Some(s) = self.sigma.iter().find(|s| !(**s >= 0.0 && s.is_finite())) {
            return Err(src.refuse(
                "covariance.sigma",
                s,
                "not a standard deviation",
                "use finite numbers not below 0",
            ));
        }
        if let Some(r) = self.correlation.iter().flatten().find(|r| !(r.abs() <= 1.0)) {
            return Err(src.refuse("covariance.correlation", r, "not a correlation", "use numbers from -1 to 1"));
        }
        Ok(())
    }
}
