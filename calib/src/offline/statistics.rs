//! STAT

/// A median absolute deviation times this is a standard deviation for Gaussian noise.
pub(crate) const MAD: f64 = 1.482_602_218_505_602;

/// Median; infinite for nothing. Not finite values count as infinite.
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
