//! Rows of numbers on a command line.

/// Finite numbers joined by commas, as many as are needed: the form in which the options' own help writes them.
pub(crate) fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let all: Result<Vec<f64>, _> = text.split(',').map(|n| n.trim().parse::<f64>()).collect();
    let finite = all.ok().filter(|v| v.iter().all(|n| n.is_finite()));
    finite.and_then(|v| v.try_into().ok()).ok_or_else(|| format!("give {N} numbers joined by commas"))
}
