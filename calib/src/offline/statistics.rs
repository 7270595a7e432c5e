//! Robust statistics that several stages share.

/// Ratio of the standard deviation to the median absolute deviation for Gaussian noise.
pub(crate) const MAD: f64 = 1.482_602_218_505_602;

/// Median of the values; infinite for an empty list. NaN and infinite values count as plus infinity.
pub(crate) fn median(mut v: Vec<f64>) -> f64 {
    if v.is_empty() {
        return f64::INFINITY;
    }
    for x in &mut v {
        if !x.is_finite() {
            *x = f64::INFINITY;
        }
    }
    let k = v.len() / 2;
    *v.select_nth_unstable_by(k, f64::total_cmp).1
}
