//! From the records of the real-time threads to the telemetry sample.

use super::cycle_report::CycleReport;
use graspd_rt::cycle::Stage;
use graspd_rt::gripper::MAX_MARKS;
use graspd_rt::mode::ModeName;
use graspd_rt::online::Vision;
use graspd_rt::online::screw::ViewMode;
use graspd_rt::setpoint::{Goal, SetPoint};
use graspd_shm::control::TelemetrySample;

/// The number for a fault code like "F-ARM-05": its group times 100 plus its own number.
pub fn fault_number(code: &str) -> u32 {
    let mut parts = code.split('-').skip(1);
    let group = match parts.next() {
        Some("CAM") => 1,
        Some("MRK") => 2,
        Some("LAW") => 3,
        Some("ARM") => 4,
        Some("TIM") => 5,
        _ => 9,
    };
    group * 100 + parts.next().and_then(|n| n.parse().ok()).unwrap_or(0)
}

/// The number for the views that close the loop.
pub(super) const fn view_number(views: ViewMode) -> u32 {
    match views {
        ViewMode::Stereo => 0,
        ViewMode::Left => 1,
        ViewMode::Right => 2,
        ViewMode::Best => 3,
    }
}

/// Copies what the last cycle knew and did.
pub(super) fn fill_cycle(sample: &mut TelemetrySample, cycle: &CycleReport, setpoint: Option<&SetPoint>) {
    let r = &cycle.record;
    sample.stamp_ns = r.now_ns;
    sample.state = r.mode as u32;
    sample.phase = match (r.mode, r.stage) {
        (ModeName::Converged, _) => 3,
        (ModeName::Servoing, Stage::Pregrasp) => 1,
        (ModeName::Servoing, Stage::Grasp) => 2,
        (ModeName::Servoing, Stage::Turn) => 5,
        (ModeName::Servoing, Stage::Retreat) => 6,
        _ => 0,
    };
    sample.ticks = r.counters.cycles;
    sample.overruns = r.counters.overruns;
    sample.setpoint = r.setpoint_id;
    sample.link = cycle.link;
    (sample.robot_mode, sample.safety_bits) = cycle.robot;
    sample.limits_active = u32::from(r.held.0);
    sample.q = r.q;
    sample.qd = r.qd;
    sample.command = r.command.rates;
    sample.screw = r.screw.into();
    sample.left_from_gripper = r.left_from_gripper.map_or([f64::NAN; 7], |p| {
        let (t, q) = (p.translation.vector, p.rotation.quaternion());
        [t.x, t.y, t.z, q.w, q.i, q.j, q.k]
    });
    sample.error_px = r.error_px;
    sample.residual_px = r.residual_px;
    sample.condition = r.mark_condition;
    sample.gain = r.scale;
    let goal = setpoint.filter(|s| s.id == r.setpoint_id).map(|s| match r.stage {
        Stage::Pregrasp | Stage::Retreat => &s.pregrasp,
        Stage::Grasp | Stage::Turn => &s.grasp,
    });
    (sample.distance_m, sample.angle_rad) = match (goal, r.left_from_gripper) {
        (Some(g), Some(p)) => {
            let d = p.inverse() * g.left_from_gripper;
            (d.translation.vector.norm(), d.rotation.angle())
        }
        _ => (f64::NAN, f64::NAN),
    };
    fill_goals(sample, goal);
}

/// Copies the tracked marks, px; NaN where a mark is not seen.
pub(super) fn fill_marks(sample: &mut TelemetrySample, vision: &Vision) {
    sample.marks_seen = vision.seen.map(u32::from);
    for (view, seen) in vision.marks.iter().enumerate() {
        for (i, mark) in seen.iter().enumerate().take(MAX_MARKS) {
            sample.marks[view][i] = mark.map_or([f32::NAN; 2], |m| [m.pixel.x as f32, m.pixel.y as f32]);
        }
    }
}

/// Copies the marks' positions at the goal, px; NaN without a goal.
fn fill_goals(sample: &mut TelemetrySample, goal: Option<&Goal>) {
    for view in 0..2 {
        for i in 0..MAX_MARKS {
            let pixel = goal.and_then(|g| g.marks[view][i]);
            sample.goals[view][i] = pixel.map_or([f32::NAN; 2], |p| [p.x as f32, p.y as f32]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::fault_number;

    #[test]
    fn codes_have_stable_numbers() {
        assert_eq!(fault_number("F-ARM-05"), 405);
        assert_eq!(fault_number("F-CAM-01"), 101);
        assert_eq!(fault_number("F-INT-01"), 901);
    }
}
