//! Plans on the first images of random cells and compares with ground truth: `plan_seeds FIRST COUNT [OCCLUSION]`.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_calib::files::RigFile;
use graspd_calib::offline::contour::select::Selection;
use graspd_calib::offline::edges::grey_image::GreyImage;
use graspd_calib::offline::plan::{PlanOptions, plan};
use graspd_hil::scenario::{Options, Scenario};
use graspd_rt::geom::View;

fn main() {
    let args: Vec<f64> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    let (first, count) = (args.first().map_or(1, |v| *v as u64), args.get(1).map_or(10, |v| *v as u64));
    let options = Options { rim_occlusion: args.get(2).copied().unwrap_or(0.0), ..Options::default() };
    for seed in first..first + count {
        let scenario = match Scenario::from_seed(seed, &options) {
            Ok(s) => s,
            Err(e) => {
                println!("{seed:4} no world: {e}");
                continue;
            }
        };
        let mut renderer = scenario.renderer();
        let (w, h) = (scenario.true_rig.left.width as usize, scenario.true_rig.left.height as usize);
        let shot = scenario.snapshot(&scenario.start, 1);
        let [l, r] = View::BOTH.map(|v| renderer.image(v, &shot).into_raw());
        let (Some(l), Some(r)) = (GreyImage::new(w, h, l), GreyImage::new(w, h, r)) else { continue };
        let clicks = scenario.clicks.map(Selection::Click);
        let rig = RigFile::new(scenario.given_rig);
        match plan([&l, &r], [&clicks[0], &clicks[1]], &rig, &scenario.gripper, &PlanOptions::default()) {
            Ok(p) => {
                let truth = scenario.left_from_object();
                let n = truth.rotation * nalgebra::Vector3::z();
                let o = &p.file.object;
                let e = nalgebra::Vector3::from(o.centre_m) - truth.translation.vector;
                let angle = nalgebra::Vector3::from(o.normal).angle(&n).to_degrees();
                let tilt = n.angle(&-truth.translation.vector).to_degrees();
                println!(
                    "{seed:4} {:9} centre {:.3} mm, normal {angle:.3} deg, tilt {tilt:.0}, a {:.2} b {:.2} mm, chi2 {:.2}, sigma {:.3} mm {:.3} deg",
                    o.model,
                    e.norm() * 1e3,
                    o.semi_axes_m[0] * 1e3,
                    o.semi_axes_m[1] * 1e3,
                    o.chi2_per_dof,
                    o.sigma_centre_mm,
                    o.sigma_normal_deg
                );
            }
            Err(e) => println!("{seed:4} refused: {e}"),
        }
    }
}
