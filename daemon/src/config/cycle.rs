//! The configuration of the command cycle.

use super::settings::Config;
use graspd_rt::arm::Dh;
use graspd_rt::cycle::{CycleConfig, CycleSettings, WatchSettings};

/// Minimum age at which the state of a CB3 controller counts as stale, ns: three and a half of its 8 ms steps, so that
/// one missing package is not a fault.
const MIN_CB3_STATE_AGE_NS: u64 = 28_000_000;

/// The configuration of the command cycle, for an arm with these kinematics, on a host that gave real-time scheduling
/// or did not.
pub fn cycle_config(c: &Config, dh: Dh, realtime: bool) -> CycleConfig {
    // A host without real-time scheduling misses cycles all the time: they are counted and reported, and only a stall
    // stops the arm. The robot's own watchdog covers that as well.
    let strict = realtime && !c.threads.best_effort;
    let mut watch = if strict { WatchSettings::default() } else { WatchSettings::best_effort() };
    if !c.arm.model.is_e_series() {
        watch.state_age_ns = watch.state_age_ns.max(MIN_CB3_STATE_AGE_NS);
    }
    watch.skew_ns = c.frames.max_skew_ns;
    CycleConfig {
        model: c.arm.model,
        dh,
        rig: c.rig.rig,
        gripper: c.gripper.gripper.clone(),
        settings: CycleSettings {
            period_ns: c.threads.period_ns(),
            frame_period_ns: c.frames.period_ns,
            law: c.law,
            path: c.path,
            limits: c.limits,
            converge: c.converge,
            watch,
            task: c.task,
            ..CycleSettings::default()
        },
    }
}
