//! Synthetic scenes for tests and for the accuracy study: a verged rig and the rims it sees, generated as in the
//! reference.

use crate::offline::rim::circle::frame_of;
use crate::offline::rim::model::Rim;
use crate::offline::types::projection::Projection;
use crate::offline::types::projection::project;
use nalgebra::{Matrix3, Vector2, Vector3};
use std::f64::consts::TAU;

/// Two cameras of 1280x1024 pixels at `x = -+ baseline / 2`, verged on `(0, 0, distance)`, y down.
pub fn rig(baseline: f64, focal: f64, distance: f64) -> [Projection; 2] {
    [-0.5, 0.5].map(|s| camera(Vector3::new(s * baseline, 0.0, 0.0), Vector3::new(0.0, 0.0, distance), focal))
}

/// A camera at `o` that looks at `target`, with its y axis as close as possible to the world's.
pub fn camera(o: Vector3<f64>, target: Vector3<f64>, focal: f64) -> Projection {
    let z = (target - o).normalize();
    let x = Vector3::y().cross(&z).normalize();
    let y = z.cross(&x);
    let r = Matrix3::from_rows(&[x.transpose(), y.transpose(), z.transpose()]);
    let k = Matrix3::new(focal, 0.0, 639.5, 0.0, focal, 511.5, 0.0, 0.0, 1.0);
    let mut p = Projection::zeros();
    p.fixed_view_mut::<3, 3>(0, 0).copy_from(&(k * r));
    p.fixed_view_mut::<3, 1>(0, 3).copy_from(&(k * (r * -o)));
    p
}

/// A rim whose normal is tilted by `tilt` from the direction to the rig's origin, about a line of the given azimuth.
pub fn rim_tilted(centre: Vector3<f64>, tilt: f64, azimuth: f64, a: f64, b: f64) -> Rim {
    let f = frame_of(&-centre);
    let n = f.column(2) * tilt.cos() + (f.column(0) * azimuth.cos() + f.column(1) * azimuth.sin()) * tilt.sin();
    rim_of(centre, n, a, b, azimuth * 1.7)
}

/// A rim from its normal and the direction `phi` of the major axis in [`frame_of`].
pub fn rim_of(centre: Vector3<f64>, n: Vector3<f64>, a: f64, b: f64, phi: f64) -> Rim {
    let f = frame_of(&n);
    let axis_a = f.column(0) * phi.cos() + f.column(1) * phi.sin();
    let normal = f.column(2).into_owned();
    Rim { centre, normal, a, b, axis_a, axis_b: normal.cross(&axis_a) }
}

/// Pixels of `n` points equally spaced in angle over the whole rim.
pub fn rim_points(p: &Projection, rim: &Rim, n: usize) -> Vec<Vector2<f64>> {
    (0..n).map(|i| project(p, &rim_point(rim, TAU * i as f64 / n as f64))).collect()
}

/// A point of the rim.
pub fn rim_point(rim: &Rim, t: f64) -> Vector3<f64> {
    rim.centre + rim.axis_a * (rim.a * t.cos()) + rim.axis_b * (rim.b * t.sin())
}

/// A small seeded generator (SplitMix64, Box-Muller), so that a study is the same on every platform.
#[derive(Clone, Debug)]
pub struct Random(u64);

impl Random {
    /// An independent stream for every seed.
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0xd134_2543_de82_ef95).wrapping_add(0x2545_f491_4f6c_dd1d))
    }

    /// The next 64 bits.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Uniform in `[from, to)`.
    pub fn uniform(&mut self, from: f64, to: f64) -> f64 {
        from + (to - from) * (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Standard normal.
    pub fn normal(&mut self) -> f64 {
        let u = self.uniform(f64::MIN_POSITIVE, 1.0);
        (-2.0 * u.ln()).sqrt() * self.uniform(0.0, TAU).cos()
    }
}
