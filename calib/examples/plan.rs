//! Plans a grasp on the front wheel of the motorcycle pair and writes `plan.toml`, `plan.png` and `plan.html`:
//! `cargo run --release -p graspd-calib --example plan [output folder]`.

use graspd_calib::files::{GripperFile, RigFile};
use graspd_calib::offline::contour::select::Selection;
use graspd_calib::offline::drawing::{overlay, report};
use graspd_calib::offline::edges::grey_image::GreyImage;
use graspd_calib::offline::plan::{PlanOptions, plan};
use graspd_rt::geom::Pixel;
use std::error::Error;
use std::path::{Path, PathBuf};

fn main() -> Result<(), Box<dyn Error>> {
    let out = std::env::args().nth(1).map_or_else(std::env::temp_dir, PathBuf::from);
    let input = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/motorcycle");
    let rig = RigFile::load(&input.join("rig.toml"))?;
    let gripper = GripperFile::load(&input.join("gripper.toml"))?;
    let left = GreyImage::load(&input.join("left.png"))?;
    let right = GreyImage::load(&input.join("right.png"))?;

    // One click on the contour in each view, pixels.
    let clicks = [Pixel::new(619.9, 435.0), Pixel::new(570.2, 435.0)].map(Selection::Click);
    let plan = plan([&left, &right], [&clicks[0], &clicks[1]], &rig, &gripper, &PlanOptions::default())?;

    let object = &plan.file.object;
    let [x, y, z] = object.centre_m.map(|v| v * 1e3);
    println!("{} at ({x:.1}, {y:.1}, {z:.1}) mm, sigma {:.2} mm", object.model, object.sigma_centre_mm);
    println!("{} handle, jaws {:.1} mm", plan.file.handle, plan.file.opening_m * 1e3);
    for warning in &plan.file.warnings {
        println!("note: {warning}");
    }

    let png = overlay::draw(&plan, [&left, &right], &rig, &gripper).ok_or("the images are too large to draw")?;
    plan.file.save(&out.join("plan.toml"))?;
    std::fs::write(out.join("plan.html"), report::html(&plan, Some(&png)))?;
    std::fs::write(out.join("plan.png"), png)?;
    println!("plan.toml, plan.png and plan.html are in {}", out.display());
    Ok(())
}
