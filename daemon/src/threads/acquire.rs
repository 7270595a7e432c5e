//! The acquisition thread: finds the marks from scratch whenever the vision thread has lost them. An ordinary thread: it searches
//! whole images, which may take tens of milliseconds.

use super::shared::{RigSeen, Seed, Shared};
use super::vision::policy;
use crate::config::Config;
use crate::realtime::now_ns;
use graspd_rt::image::ImageView;
use graspd_rt::online::acquire::{AcquireFailure, AcquireScratch, AcquireSettings, acquire};
use graspd_shm::frame::FrameSubscriber;
use graspd_shm::{ShmError, ShmNode};
use std::sync::Mutex;
use std::sync::atomic::Ordering;
use std::time::Duration;

/// Why the marks are not found, in words, for the status verb. Written and read by ordinary threads only.
#[derive(Debug, Default)]
pub struct AcquireReport {
    text: Mutex<String>,
}

impl AcquireReport {
    fn set(&self, text: String) {
        // A poisoned lock still holds a string; whoever panicked was reporting, not deciding.
        *self.text.lock().unwrap_or_else(std::sync::PoisonError::into_inner) = text;
    }

    /// The last failure in words, empty after a success.
    pub fn text(&self) -> String {
        self.text.lock().unwrap_or_else(std::sync::PoisonError::into_inner).clone()
    }
}

fn words(failure: &AcquireFailure) -> String {
    match failure {
        AcquireFailure::Size(view) => format!("the {view:?} image has not the size of the rig's camera"),
        AcquireFailure::TooFewBlobs { found } => format!(
            "too few round marks in sight ({} left, {} right): marks hidden, out of focus, too dark or too small",
            found[0], found[1]
        ),
        AcquireFailure::TooFewPairs { found } => format!(
            "only {found} marks agree between the views: views swapped, wrong rig calibration, or gripper seen by one camera only"
        ),
        AcquireFailure::NoConstellation => {
            "no four marks stand as in the gripper file: another gripper, or wrong mark positions".into()
        }
        AcquireFailure::NotVerified { seen, residual_px } => format!(
            "a pose was found but does not hold in the images ({} and {} marks, residual {residual_px:.1} px)",
            seen[0], seen[1]
        ),
        AcquireFailure::RigOff { sigmas, residual_px } => format!(
            "the marks fit only with a rig {sigmas:.0} times as wrong as it states (residual {residual_px:.1} px): a camera was moved, rig.toml is another rig's, or this gripper has another size; check the calibration, or state its error in [quality]"
        ),
        AcquireFailure::Ambiguous { .. } => {
            "two poses explain the images equally well: the mark that tells them apart is hidden, or the layout is symmetric".into()
        }
    }
}

/// A residual above which the rig itself is worth a word, pixels: it comes with a millimetre at the grasp.
const POOR_RIG_PX: f64 = 0.5;
/// Deviations of its stated error above which a rig is likelier to be stated wrongly than to be off by chance.
const POOR_RIG_SIGMAS: f64 = 4.0;

/// What the marks say against the rig while they are tracked; empty when nothing.
fn rig_words(s: &RigSeen, marks: usize) -> String {
    let mut said = Vec::new();
    let [residual, inner] = s.residual_px;
    if s.rig.moves > 0 {
        said.push(format!(
            "a camera was moved {} time(s) since the start, the last by what leads the gripper {:.1} mm astray: check the calibration; plans from before are refused",
            s.rig.moves,
            s.rig.astray_m * 1e3
        ));
    } else if s.rig.shakes > 0 {
        said.push(format!(
            "a camera moved slightly {} time(s), by what leads the gripper {:.1} mm astray: fasten it",
            s.rig.shakes,
            s.rig.astray_m * 1e3
        ));
    }
    if s.rig.offset_sigmas > POOR_RIG_SIGMAS {
        said.push(format!(
            "the rig seems {:.0} times as wrong as it states (residual {residual:.2} px, {inner:.2} px with that taken out): calibrate again, or state its error in [quality] of rig.toml",
            s.rig.offset_sigmas
        ));
    } else if residual > POOR_RIG_PX {
        let why = if inner < 0.5 * residual {
            "the rig's calibration is off: calibrate again for less than a millimetre at the grasp"
        } else {
            "the marks do not stand as the gripper file says, or are poorly seen"
        };
        said.push(format!("residual {residual:.2} px: {why}"));
    }
    if s.seen.iter().any(|n| *n < 3) {
        said.push("only one view shows the marks".into());
    }
    if said.is_empty() {
        return String::new();
    }
    format!("{} left, {} right of {marks}; {}", s.seen[0], s.seen[1], said.join("; "))
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
                report.set(rig_words(&seen, config.gripper.gripper.marks.len()));
            }
            continue;
        }
        let received = subscriber.newest(now_ns());
        let Some(frame) = received.frame else { continue };
        let (w, h) = (frame.width(), frame.height());
        for (eye, buffer) in converted.iter_mut().enumerate() {
            buffer.resize(w * h, 0);
            if !frame.write_mono8(eye, buffer) {
                continue;
            }
        }
        let (Some(left), Some(right)) =
            (ImageView::new(&converted[0], w, h, w), ImageView::new(&converted[1], w, h, w))
        else {
            continue;
        };
        match acquire(&config.rig.rig, &config.gripper.gripper, &left, &right, &settings, &mut scratch) {
            Ok(found) => {
                let [a, b] = frame.capture_ns();
                shared
                    .seed
                    .put(Seed { left_from_gripper: found.left_from_gripper, capture_ns: a.min(b) + a.abs_diff(b) / 2 });
                report.set(String::new());
                // Give the vision thread a few frames to take it over before looking again.
                std::thread::sleep(Duration::from_millis(60));
            }
            Err(failure) => report.set(words(&failure)),
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use graspd_rt::online::rig_watch::RigHealth;

    #[test]
    fn a_good_rig_says_nothing_and_every_other_says_why() {
        let good = RigSeen { rig: RigHealth::default(), seen: [12, 11], residual_px: [0.02, 0.01] };
        assert_eq!(rig_words(&good, 16), "");
        let says = |s: RigSeen, what: &str| {
            let text = rig_words(&s, 16);
            assert!(text.starts_with(&format!("{} left, {} right of 16; ", s.seen[0], s.seen[1])), "{text}");
            assert!(text.contains(what), "{text}");
        };
        says(RigSeen { residual_px: [1.2, 0.05], ..good }, "the rig's calibration is off");
        says(RigSeen { residual_px: [1.2, 1.1], ..good }, "gripper file");
        says(RigSeen { rig: RigHealth { offset_sigmas: 6.0, ..good.rig }, ..good }, "6 times as wrong as it states");
        says(RigSeen { rig: RigHealth { moves: 1, astray_m: 0.007, ..good.rig }, ..good }, "7.0 mm astray");
        says(RigSeen { rig: RigHealth { shakes: 2, astray_m: 0.0003, ..good.rig }, ..good }, "fasten it");
        says(RigSeen { seen: [9, 0], ..good }, "only one view");
    }
}
