//! Detection, labels and accuracy on rendered targets with known positions.

use super::*;
use graspd_rt::geom::{Camera, Distortion, Pose, Vec3, exp_twist};
use nalgebra::Vector6;
use rand::SeedableRng;
use rand_distr::{Distribution, Normal};

fn camera() -> Camera {
    let distortion = Distortion { k1: -0.15, k2: 0.04, ..Default::default() };
    Camera { width: 640, height: 480, fx: 600.0, fy: 600.0, cx: 322.0, cy: 238.0, distortion }
}

/// Grey value of the target's plane at a point given in metres.
fn paint(target: &Target, x: f64, y: f64) -> f64 {
    let (u, v) = (x / target.spacing, y / target.spacing);
    let inside = u > -1.0 && v > -1.0 && u < target.cols as f64 && v < target.rows as f64;
    let dark = match target.disc() {
        None => inside && (u.floor() + v.floor()).rem_euclid(2.0) == 0.0,
        Some(d) => {
            let (du, dv) = ((u - u.round()) * target.spacing, (v - v.round()) * target.spacing);
            inside
                && u.round() < target.cols as f64
                && v.round() < target.rows as f64
                && u > -0.5
                && v > -0.5
                && du.hypot(dv) < 0.5 * d
        }
    };
    if dark { 40.0 } else { 200.0 }
}

/// Renders the target with 5 x 5 rays per pixel and noise.
fn render(target: &Target, pose: &Pose, seed: u64) -> GreyImage {
    let (c, back) = (camera(), pose.inverse());
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let noise = Normal::new(0.0, 2.0).unwrap();
    let mut data = Vec::new();
    for v in 0..480 {
        for u in 0..640 {
            let mut sum = 0.0;
            for k in 0..25 {
                let at = Pixel::new(
                    f64::from(u) - 0.4 + 0.2 * f64::from(k % 5),
                    f64::from(v) - 0.4 + 0.2 * f64::from(k / 5),
                );
                let ray = back.rotation * c.ray(at).unwrap();
                let origin = back.translation.vector;
                let p: Vec3 = origin - ray * (origin.z / ray.z);
                sum += paint(target, p.x, p.y);
            }
            data.push((sum / 25.0 + noise.sample(&mut rng)).round().clamp(0.0, 255.0) as u8);
        }
    }
    GreyImage::new(640, 480, data).unwrap()
}

fn pose(target: &Target, turn: [f64; 3]) -> Pose {
    let size = target.size();
    exp_twist(&Vector6::new(0.01, -0.01, 0.4, 0.0, 0.0, 0.0))
        * exp_twist(&Vector6::new(0.0, 0.0, 0.0, turn[0], turn[1], turn[2]))
        * exp_twist(&Vector6::new(-0.5 * size.x, -0.5 * size.y, 0.0, 0.0, 0.0, 0.0))
}

/// Root mean square distance between detected and true points; a wrong label makes it large.
fn error_px(target: &Target, pose: &Pose, found: &Found) -> f64 {
    let c = camera();
    let turn = pose.rotation;
    let squares = found.points.iter().map(|s| {
        let p = target.point(s.index);
        let x = (pose * nalgebra::Point3::new(p.x, p.y, 0.0)).coords;
        let mut at = c.project(&x).unwrap();
        if let Some(d) = target.disc() {
            let (a, b) = (turn * Vec3::x(), turn * Vec3::y());
            at += crate::calibrate::rig::parameters::disc_bias(&c, &x, &a, &b, 0.5 * d).unwrap();
        }
        (s.at - at).norm_squared()
    });
    (squares.sum::<f64>() / found.points.len() as f64).sqrt()
}

#[test]
fn rendered_targets_are_measured_to_hundredths_of_a_pixel() {
    for (text, rotations) in [
        ("chessboard:9x6:0.025", [[0.0, 0.0, 0.05], [0.5, 0.3, 0.2], [-0.4, 0.5, -0.3]]),
        ("circles:9x6:0.025:0.014", [[0.0, 0.0, 0.05], [0.5, 0.3, 0.2], [-0.4, 0.5, -0.3]]),
    ] {
        let target = Target::parse(text).unwrap();
        for (k, turn) in rotations.into_iter().enumerate() {
            let pose = pose(&target, turn);
            let found = find(&render(&target, &pose, k as u64), &target).unwrap();
            assert_eq!(found.points.len(), 54, "{text} {turn:?}");
            let e = error_px(&target, &pose, &found);
            assert!(e < 0.05, "{text} {turn:?}: {e} px");
            // The stated covariance agrees with the error, within the uncertainty of blur and pixel size.
            let stated = (found.points.iter().map(|s| s.covariance.trace()).sum::<f64>() / 54.0).sqrt();
            assert!(e / stated < 4.0 && stated < 0.1, "{text}: {e} px, stated {stated} px");
        }
    }
}

#[test]
fn images_without_the_target_are_rejected_with_the_reason() {
    let target = Target::parse("chessboard:9x6:0.025").unwrap();
    let grey = GreyImage::new(640, 480, vec![128; 640 * 480]).unwrap();
    assert!(find(&grey, &target).unwrap_err().to_string().contains("no chessboard"));
    let circles = Target::parse("circles:9x6:0.025:0.014").unwrap();
    assert!(find(&grey, &circles).unwrap_err().to_string().contains("no circle grid"));
    let image = render(&target, &pose(&target, [0.1, 0.2, 0.0]), 1);
    let larger = Target::parse("chessboard:11x8:0.025").unwrap();
    let e = find(&image, &larger).unwrap_err().to_string();
    assert!(e.contains("9x6") && e.contains("11x8"), "{e}");
}
