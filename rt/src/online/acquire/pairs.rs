//! Pairs blobs of the left and the right image, and triangulates them.

use super::blobs::{Blob, MAX_BLOBS};
use crate::geom::{Normalized, Rig, RigError, Vec3, View};
use crate::gripper::Gripper;
use crate::math;
use nalgebra::Vector3;

/// Most points kept; an ambiguous blob gives several.
pub const MAX_POINTS: usize = 512;

/// A possible mark in space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct StereoPoint {
    /// Position in the left frame, metres.
    pub(crate) position: Vec3,
    /// Radius of a disc with that image at that distance, metres.
    pub(crate) radius: f64,
    pub(crate) dark: bool,
    /// Index of the blob in each view.
    pub(crate) blob: [u16; 2],
}

/// Gate on the epipolar distance, and tolerance of the sizes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PairLimits {
    /// The stated error of the rig, which gives the standard deviation of the epipolar distance.
    pub(crate) rig_error: RigError,
    /// Gate on the epipolar distance, standard deviations.
    pub(crate) sigmas: f64,
    /// Error of the centroids of two blobs, pixels.
    pub(crate) blob_px: f64,
    pub(crate) size_factor: f64,
}

/// Pairs blobs of both views whose rays pass closely in front of both cameras, at a distance at which a mark has their
/// size.
pub(crate) fn pair(
    rig: &Rig,
    gripper: &Gripper,
    blobs: &[heapless::Vec<Blob, MAX_BLOBS>; 2],
    limits: &PairLimits,
    out: &mut heapless::Vec<StereoPoint, MAX_POINTS>,
) {
    out.clear();
    let left_from_right = rig.right_from_left.inverse();
    let baseline = left_from_right.translation.vector;
    let [left, right] = blobs;
    // Rays of the right view are computed once, not once per pair.
    let mut rays: heapless::Vec<Option<Vec3>, MAX_BLOBS> = heapless::Vec::new();
    for b in right {
        let ray = rig.camera(View::Right).undistort(b.centre).map(|n| left_from_right.rotation * lift(n));
        let _ = rays.push(ray);
    }
    let (fl, fr) = (0.5 * (rig.left.fx + rig.left.fy), 0.5 * (rig.right.fx + rig.right.fy));
    for (i, l) in left.iter().enumerate() {
        let Some(a) = rig.camera(View::Left).undistort(l.centre).map(lift) else { continue };
        for (j, (r, b)) in right.iter().zip(&rays).enumerate() {
            let Some(b) = b else { continue };
            if l.dark != r.dark {
                continue;
            }
            let Some((s, t)) = closest(&a, b, &baseline) else { continue };
            if !(s > 0.0 && t > 0.0) {
                continue;
            }
            let (p, q) = (a * s, baseline + b * t);
            let (radius_l, radius_r) = (l.major * s / fl, r.major * t / fr);
            let ratio = radius_l / radius_r;
            let radius = 0.5 * (radius_l + radius_r);
            let like = |m: f64| radius < m * limits.size_factor && radius * limits.size_factor > m;
            if ratio > limits.size_factor
                || ratio * limits.size_factor < 1.0
                || !gripper.marks.iter().any(|m| m.dark == l.dark && like(m.radius))
            {
                continue;
            }
            // The gap between the rays in pixels of the cameras, compared with the effect of the rig's error.
            let gap = math::sqrt((p - q).norm_squared()) * fl / s.min(t);
            let middle = (p + q) * 0.5;
            let sigma = limits.rig_error.epipolar_sigma_px(rig, &middle).unwrap_or(0.0);
            if gap > limits.sigmas * math::hypot(sigma, limits.blob_px) {
                continue;
            }
            let point = StereoPoint { position: middle, radius, dark: l.dark, blob: [i as u16, j as u16] };
            if out.push(point).is_err() {
                return;
            }
        }
    }
}

fn lift(n: Normalized) -> Vec3 {
    Vector3::new(n.x, n.y, 1.0)
}

/// Parameters of the closest points of the rays `a s` and `c + b t`; `None` for parallel rays.
fn closest(a: &Vec3, b: &Vec3, c: &Vec3) -> Option<(f64, f64)> {
    let (aa, bb, ab) = (a.dot(a), b.dot(b), a.dot(b));
    let det = aa * bb - ab * ab;
    if !(det > 1e-9 * aa * bb) {
        return None;
    }
    let (ac, bc) = (a.dot(c), b.dot(c));
    Some(((ac * bb - ab * bc) / det, (ac * ab - aa * bc) / det))
}
