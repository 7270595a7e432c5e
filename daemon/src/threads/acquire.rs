//! The acquisition thread: finds the marks without a prediction when the vision thread has lost them. An ordinary
//! thread, because a search of complete images may take tens of milliseconds.

use super::frame_refusal::FrameRefusal;
use super::shared::{RigSeen, Seed, Shared};
use super::vision::policy;
use crate::config::Config;
use crate::realtime::now_ns;
use graspd_rt::image::ImageView;
use graspd_rt::online::acquire::{AcquireFailure, AcquireScratch, AcquireSettings, acquire};
use graspd_rt::online::mid_exposure_ns;
use graspd_shm::frame::FrameSubscriber;
use graspd_shm::{ShmError, ShmNode};
use std::sync::Mutex;
use std::sync::atomic::Ordering;
use std::time::Duration;

/// Why the marks are not found, as text for the status verb. Written and read by ordinary threads only.
#[derive(Debug, Default)]
pub struct AcquireReport {
    text: Mutex<String>,
}

impl AcquireReport {
    fn set(&self, text: String) {
        // A poisoned lock still holds a valid string.
        *self.text.lock().unwrap_or_else(std::sync::PoisonError::into_inner) = text;
    }

    /// The last failure, empty after a success.
    pub fn text(&self) -> String {
        self.text.lock().unwrap_or_else(std::sync::PoisonError::into_inner).clone()
    }
}

fn failure_text(failure: &AcquireFailure) -> String {
    match failure {
        AcquireFailure::Size(view) => format!("the {view:?} image size differs from the rig's camera: publish full images of the calibrated camera"),
        AcquireFailure::TooFewBlobs { found } => format!(
            "too few round marks visible ({} left, {} right): marks hidden, out of focus, too dark or too small",
            found[0], found[1]
        ),
        AcquireFailure::TooFewPairs { found } => format!(
            "only {found} marks agree between the views: views swapped, wrong rig calibration, or gripper seen by one camera only"
        ),
        AcquireFailure::NoConstellation => {
            "no four marks are arranged as in the gripper file: another gripper, or wrong mark positions".into()
        }
        AcquireFailure::NotVerified { seen, residual_px } => format!(
            "a pose was found, but the images do not confirm it ({} and {} marks, residual {residual_px:.1} px)",
            seen[0], seen[1]
        ),
        AcquireFailure::RigOff { sigmas, residual_px } => format!(
            "the marks fit only with a rig error of {sigmas:.0} times the stated one (residual {residual_px:.1} px): a camera has moved, rig.toml belongs to another rig, or the gripper has another size; check the calibration, or state its error in [quality] of rig.toml"
        ),
        AcquireFailure::Ambiguous { .. } => {
            "two poses explain the images equally well: the mark that distinguishes them is hidden, or the layout is symmetric".into()
        }
    }
}

/// Maximum residual of the marks without a remark in the status, px; above it the position error at the grasp is about
/// a millimetre.
const MAX_GOOD_RESIDUAL_PX: f64 = 0.5;
/// Maximum rig error without a remark in the status, standard deviations of its stated error; above it a wrong
/// statement is likelier than chance.
const MAX_GOOD_RIG_SIGMAS: f64 = 4.0;

/// Remarks on the rig while the marks are tracked; empty where there are none.
fn rig_text(s: &RigSeen, marks: usize) -> String {
    let mut remarks = Vec::new();
    let [residual, inner] = s.residual_px;
    if s.rig.moves > 0 {
        remarks.push(format!(
            "a camera moved {} time(s) since the start; the last move displaces the gripper by {:.1} mm: check the calibration; earlier plans are refused",
            s.rig.moves,
            s.rig.astray_m * 1e3
        ));
    } else if s.rig.shakes > 0 {
        remarks.push(format!(
            "a camera moved slightly {} time(s), which displaces the gripper by {:.1} mm: fasten it",
            s.rig.shakes,
            s.rig.astray_m * 1e3
        ));
    }
    if s.rig.offset_sigmas > MAX_GOOD_RIG_SIGMAS {
        remarks.push(format!(
            "the rig error is about {:.0} times the stated one (residual {residual:.2} px, {inner:.2} px without it): calibrate again, or state the error in [quality] of rig.toml",
            s.rig.offset_sigmas
        ));
    } else if residual > MAX_GOOD_RESIDUAL_PX {
        let why = if inner < 0.5 * residual {
            "the rig calibration is inaccurate: calibrate again for less than a millimetre at the grasp"
        } else {
            "the marks are not where the gripper file has them, or the images are poor"
        };
        remarks.push(format!("residual {residual:.2} px: {why}"));
    }
    if s.seen.iter().any(|n| *n < 3) {
        remarks.push("only one view shows the marks".into());
    }
    if remarks.is_empty() {
        return String::new();
    }
    format!("{} left, {} right of {marks}; {}", s.seen[0], s.seen[1], remarks.join("; "))
}

/// Both views of a pair as grey images of `size` (width, height), in `buffers`. `convert` writes one view and returns
/// whether it could.
///
/// `None` when a view cannot be converted: its buffer still holds an earlier image then, which must not be searched.
fn grey_images(
    size: (usize, usize),
    buffers: &mut [Vec<u8>; 2],
    mut convert: impl FnMut(usize, &mut [u8]) -> bool,
) -> Option<[ImageView<'_>; 2]> {
    let (w, h) = size;
    for (view, buffer) in buffers.iter_mut().enumerate() {
        buffer.resize(w * h, 0);
        if !convert(view, buffer) {
            return None;
        }
    }
    let [left, right] = buffers;
    Some([ImageView::new(left, w, h, w)?, ImageView::new(right, w, h, w)?])
}

/// Runs until shutdown.
///
/// # Errors
/// When the frame topic cannot be joined.
pub fn run(config: &Config, node: &ShmNode, shared: &Shared, report: &AcquireReport) -> Result<(), ShmError> {
    let mut subscriber = FrameSubscriber::new(node, policy(config))?;
    let mut scratch = Box::new(AcquireScratch::new());
    let settings = AcquireSettings { rig_error: config.rig.error(), ..AcquireSettings::default() };
    let mut converted = [Vec::new(), Vec::new()];
    while !shared.ending() {
        std::thread::sleep(Duration::from_millis(20));
        if !shared.needs_seed.load(Ordering::Acquire) {
            if let Some(seen) = shared.rig_seen.take() {
                report.set(rig_text(&seen, config.gripper.gripper.marks.len()));
            }
            continue;
        }
        let received = subscriber.newest(now_ns());
        let Some(frame) = received.frame else { continue };
        let size = (frame.width(), frame.height());
        let images = grey_images(size, &mut converted, |view, buffer| frame.write_mono8(view, buffer));
        let Some([left, right]) = images else {
            report.set(FrameRefusal::text(FrameRefusal::Images.number()));
            continue;
        };
        match acquire(&config.rig.rig, &config.gripper.gripper, &left, &right, &settings, &mut scratch) {
            Ok(found) => {
                let capture_ns = mid_exposure_ns(frame.capture_ns());
                shared.seed.put(Seed { left_from_gripper: found.left_from_gripper, capture_ns });
                report.set(String::new());
                // The vision thread needs a few frames to start tracking from the seed.
                std::thread::sleep(Duration::from_millis(60));
            }
            Err(failure) => report.set(failure_text(&failure)),
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use graspd_rt::online::rig_watch::RigHealth;

    #[test]
    fn a_pair_with_a_view_that_cannot_be_converted_is_not_searched() {
        let mut buffers = [Vec::new(), Vec::new()];
        let images = grey_images((4, 2), &mut buffers, |view, pixels| {
            pixels.fill(10 + view as u8);
            true
        })
        .unwrap();
        assert!(images.iter().zip([10, 11]).all(|(image, grey)| image.at(3, 1) == grey));
        // The buffers hold these images now. A view that fails must not be replaced by its last image.
        for bad in 0..2 {
            assert!(grey_images((4, 2), &mut buffers, |view, _| view != bad).is_none(), "view {bad}");
        }
    }

    #[test]
    fn a_good_rig_has_no_remarks_and_every_other_has_a_reason() {
        let good = RigSeen { rig: RigHealth::default(), seen: [12, 11], residual_px: [0.02, 0.01] };
        assert_eq!(rig_text(&good, 16), "");
        let remarks = |s: RigSeen, what: &str| {
            let text = rig_text(&s, 16);
            assert!(text.starts_with(&format!("{} left, {} right of 16; ", s.seen[0], s.seen[1])), "{text}");
            assert!(text.contains(what), "{text}");
        };
        remarks(RigSeen { residual_px: [1.2, 0.05], ..good }, "the rig calibration is inaccurate");
        remarks(RigSeen { residual_px: [1.2, 1.1], ..good }, "gripper file");
        remarks(RigSeen { rig: RigHealth { offset_sigmas: 6.0, ..good.rig }, ..good }, "6 times the stated one");
        remarks(RigSeen { rig: RigHealth { moves: 1, astray_m: 0.007, ..good.rig }, ..good }, "by 7.0 mm");
        remarks(RigSeen { rig: RigHealth { shakes: 2, astray_m: 0.0003, ..good.rig }, ..good }, "fasten it");
        remarks(RigSeen { seen: [9, 0], ..good }, "only one view");
    }
}
