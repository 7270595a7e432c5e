//! Scalar functions without `std`, from one library on every platform, so that a replay is exact to the bit.

pub use libm::{acos, asin, atan, atan2, ceil, cos, exp, fabs, floor, fmod, hypot, log, pow, round, sin, sqrt, tan};

/// Sine and cosine of an angle in radians.
#[inline]
pub fn sin_cos(a: f64) -> (f64, f64) {
    (sin(a), cos(a))
}

/// The square.
#[inline]
pub fn sq(a: f64) -> f64 {
    a * a
}
