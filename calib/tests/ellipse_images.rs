//! Painted ellipses and circles in rendered images: found by one click per view, accurate, and not mistaken for bars.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_calib::files::{GripperFile, RigFile};
use graspd_calib::offline::contour::select::Selection;
use graspd_calib::offline::edges::grey_image::GreyImage;
use graspd_calib::offline::plan::{Plan, PlanError, PlanOptions, plan};
use graspd_calib::offline::rim::model::{Rim, RimModel};
use graspd_calib::offline::rim::synthetic::{Random, rim_tilted};
use graspd_rt::geom::{Pixel, Vec3, View};

const RIG: &str = r#"schema = "graspd-rig/1"
name = "two cameras half a metre apart, turned inwards"
[left]
width = 1280
height = 1024
fx = 1200.0
fy = 1200.0
cx = 639.5
cy = 511.5
[right]
width = 1280
height = 1024
fx = 1200.0
fy = 1200.0
cx = 639.5
cy = 511.5
[right_from_left]
translation_m = [-0.4726, 0.0, 0.1632]
rotation_vector_rad = [0.0, 0.3302, 0.0]
"#;

/// A painted disc on a darker board that fills the view, through a lens of 0.6 px blur, with 2 grey levels of noise.
fn image(rig: &RigFile, view: View, rim: &Rim, r: &mut Random) -> GreyImage {
    const FINE: usize = 4;
    let camera = rig.rig.camera(view);
    let from_left = rig.rig.view_from_left(view);
    let (w, h) = (camera.width as usize, camera.height as usize);
    let eye = from_left.inverse().translation.vector;
    let mut covered = vec![0.0f64; w * h];
    let at = rig.rig.project(view, &rim.centre).unwrap();
    let reach = 1.4 * rim.a * camera.fx / (rim.centre - eye).norm();
    let (u0, u1) = ((at.x - reach) as usize, (at.x + reach) as usize);
    let (v0, v1) = ((at.y - reach) as usize, (at.y + reach) as usize);
    for v in v0..v1 {
        for u in u0..u1 {
            let mut inside = 0;
            for k in 0..FINE * FINE {
                let sub = |i: usize| (i as f64 + 0.5) / FINE as f64 - 0.5;
                let p = Pixel::new(u as f64 + sub(k % FINE), v as f64 + sub(k / FINE));
                let d = Vec3::new((p.x - camera.cx) / camera.fx, (p.y - camera.cy) / camera.fy, 1.0);
                let ray = from_left.rotation.inverse() * d;
                let x = eye + ray * ((rim.centre - eye).dot(&rim.normal) / ray.dot(&rim.normal)) - rim.centre;
                inside += usize::from((x.dot(&rim.axis_a) / rim.a).hypot(x.dot(&rim.axis_b) / rim.b) < 1.0);
            }
            covered[v * w + u] = inside as f64 / (FINE * FINE) as f64;
        }
    }
    let kernel: Vec<f64> = (-3..=3).map(|k: i32| (-0.5 * (f64::from(k) / 0.6).powi(2)).exp()).collect();
    let total: f64 = kernel.iter().sum();
    let blur = |from: &[f64], step: usize| -> Vec<f64> {
        let mut to = vec![0.0; from.len()];
        for i in 3 * step..from.len() - 3 * step {
            to[i] = kernel.iter().enumerate().map(|(k, g)| g * from[i + k * step - 3 * step]).sum::<f64>() / total;
        }
        to
    };
    let soft = blur(&blur(&covered, 1), w);
    let grey = soft.iter().map(|c| (60.0 + 110.0 * c + 2.0 * r.normal()).round().clamp(0.0, 255.0) as u8).collect();
    GreyImage::new(w, h, grey).unwrap()
}

fn planned(rig: &RigFile, gripper: &GripperFile, rim: &Rim, r: &mut Random) -> Result<Plan, PlanError> {
    let images = View::BOTH.map(|v| image(rig, v, rim, r));
    // On the rim, at nearly the same point in both views, with the error of a hand.
    let point = rim.centre + rim.axis_b * rim.b;
    let click = View::BOTH.map(|v| {
        let p = rig.rig.project(v, &point).unwrap();
        Selection::Click(Pixel::new(p.x + r.uniform(-1.5, 1.5), p.y + r.uniform(-1.5, 1.5)))
    });
    plan([&images[0], &images[1]], [&click[0], &click[1]], rig, gripper, &PlanOptions::default())
}

#[test]
fn plane_ellipses_of_every_axis_ratio_are_found_accurately() {
    let rig = RigFile::parse(RIG, "rig.toml").unwrap();
    let here = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut gripper = GripperFile::load(&here.join("../examples/motorcycle/gripper.toml")).unwrap();
    gripper.opening = [0.0, 1.0];
    let mut r = Random::new(31);
    let mut worst = (0.0f64, 0.0f64);
    for k in 0..18 {
        let ratio = [0.55, 0.7, 0.8, 0.9, 0.95, 1.0][k % 6];
        let middle = Vec3::new(0.23, 0.0, 1.4);
        let centre = middle + Vec3::new(r.uniform(-0.06, 0.06), r.uniform(-0.06, 0.06), r.uniform(-0.1, 0.1));
        let a = r.uniform(0.06, 0.09);
        let mut rim = rim_tilted(centre, r.uniform(0.1, 0.6), r.uniform(0.0, 6.3), a, a * ratio);
        if centre.dot(&rim.normal) > 0.0 {
            rim.normal = -rim.normal;
            rim.axis_b = -rim.axis_b;
        }
        let got = planned(&rig, &gripper, &rim, &mut r).unwrap_or_else(|e| panic!("ratio {ratio}: {e}"));
        let q = &got.reconstruction;
        let (c, n) = ((q.rim.centre - rim.centre).norm() * 1e3, q.rim.normal.angle(&rim.normal).to_degrees());
        println!("ratio {ratio}: {:?} {:.4}, centre {c:.3} mm, normal {n:.3} degrees", q.model, q.rim.b / q.rim.a);
        assert_eq!(q.model, if ratio == 1.0 { RimModel::Circle } else { RimModel::Ellipse });
        assert!((q.rim.b / q.rim.a - ratio).abs() < 0.01);
        worst = (worst.0.max(c), worst.1.max(n));
    }
    assert!(worst.0 < 0.15 && worst.1 < 0.2, "{worst:?}");
}
