//! Lists of numbers on a command line.

/// Parses exactly `N` finite numbers separated by commas.
pub(crate) fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let all: Result<Vec<f64>, _> = text.split(',').map(|n| n.trim().parse::<f64>()).collect();
    let finite = all.ok().filter(|v| v.iter().all(|n| n.is_finite()));
    finite
        .and_then(|v| v.try_into().ok())
        .ok_or_else(|| format!("expected {N} numbers separated by commas, without NaN or infinity"))
}
