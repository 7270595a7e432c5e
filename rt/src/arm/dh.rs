//! The Denavit-Hartenberg table, which holds all that is known of an arm's geometry.

/// Denavit-Hartenberg table, standard convention: frame i is frame i-1 turned by `q + theta` about z, shifted by `d`
/// along z and by `a` along the new x, and turned by `alpha` about it.
///
/// The base frame is UR's own (the pendant's "Base"), without the half turn of the URDF's `base_link`. The calibration
/// of a unit adds small offsets in all columns. Its `d` of joints 2 and 3 may be large and opposite: their axes are
/// parallel, so only the sum matters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Dh {
    /// Link lengths, metres.
    pub a: [f64; 6],
    /// Link offsets, metres.
    pub d: [f64; 6],
    /// Link twists, rad.
    pub alpha: [f64; 6],
    /// Offsets added to the joint angles, rad.
    pub theta: [f64; 6],
}

impl Dh {
    /// This table with another added entry by entry: nominal plus a unit's calibration deltas.
    pub fn plus(&self, delta: &Dh) -> Self {
        let add = |x: &[f64; 6], y: &[f64; 6]| core::array::from_fn(|i| x[i] + y[i]);
        Self {
            a: add(&self.a, &delta.a),
            d: add(&self.d, &delta.d),
            alpha: add(&self.alpha, &delta.alpha),
            theta: add(&self.theta, &delta.theta),
        }
    }

    /// Whether every entry is a finite number.
    pub fn is_finite(&self) -> bool {
        [&self.a, &self.d, &self.alpha, &self.theta].into_iter().flatten().all(|v| v.is_finite())
    }
}
