//! The telemetry sample: state and figures of the loop in a fixed layout (`CONTROL.md` has the same table).

use iceoryx2::prelude::ZeroCopySend;

/// "GTEL" in ASCII, the first four bytes of every sample.
pub const TELEMETRY_MAGIC: u32 = u32::from_le_bytes(*b"GTEL");
/// Layout version of [`TelemetrySample`].
pub const TELEMETRY_VERSION: u32 = 1;
/// Largest number of marks in a sample.
pub const TELEMETRY_MARKS: usize = 32;
/// Bytes of [`TelemetrySample::cause`].
pub const TELEMETRY_TEXT: usize = 256;

/// Percentiles of one latency, microseconds, since the last change from armed to servoing.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("GraspdPercentiles")]
#[allow(missing_docs)]
pub struct Percentiles {
    pub p50: f32,
    pub p99: f32,
    pub p999: f32,
    pub max: f32,
}

/// One telemetry sample, published 50 times a second by an ordinary thread of the daemon.
#[repr(C)]
#[derive(Clone, Copy, Debug, ZeroCopySend)]
#[type_name("GraspdTelemetry")]
pub struct TelemetrySample {
    /// [`TELEMETRY_MAGIC`].
    pub magic: u32,
    /// [`TELEMETRY_VERSION`].
    pub layout_version: u32,
    /// Number of the sample.
    pub sequence: u64,
    /// CLOCK_MONOTONIC nanoseconds of the cycle this sample describes.
    pub stamp_ns: u64,
    /// 0 idle, 1 tracking, 2 armed, 3 servoing, 4 converged, 5 stopping, 6 fault.
    pub state: u32,
    /// Number of the latched fault: that of its code, F-ARM-05 is 405; 0 none.
    pub fault: u32,
    /// Part of the task: 0 none, 1 to the pre-grasp, 2 to the grasp, 3 holding on the goal (gripper motion included), 5
    /// turn, 6 retreat; 4 is unused.
    pub phase: u32,
    /// 0 stereo, 1 left, 2 right, 3 best.
    pub views: u32,
    /// Cycles of the command thread since start.
    pub ticks: u64,
    /// Cycles missed: whole periods in which the command thread did not run.
    pub overruns: u64,
    /// Stereo pairs tracked.
    pub frames: u64,
    /// Stereo pairs that the tracker did not see: lost, or skipped for a newer one.
    pub frames_skipped: u64,
    /// Stereo pairs refused by a check.
    pub frames_refused: u64,
    /// Identity of the set-point; 0 none.
    pub setpoint: u64,
    /// 0 down, 1 connecting, 2 up.
    pub link: u32,
    /// The controller's robot mode; 7 is running.
    pub robot_mode: i32,
    /// The controller's safety status bits.
    pub safety_bits: u32,
    /// Limits that changed this cycle's command: the bits of `graspd_rt::guard::Held`.
    pub limits_active: u32,
    /// Measured joint positions, rad.
    pub q: [f64; 6],
    /// Measured joint velocities, rad/s.
    pub qd: [f64; 6],
    /// Commanded joint velocities, rad/s.
    pub command: [f64; 6],
    /// Commanded screw in the gripper frame, m/s and rad/s.
    pub screw: [f64; 6],
    /// Gripper pose in the frame of the left camera: x, y, z (m), then quaternion w, x, y, z; NaN before the marks were
    /// seen.
    pub left_from_gripper: [f64; 7],
    /// Root mean square distance of the marks from the moving reference, px per coordinate; NaN while the law does not
    /// drive.
    pub error_px: f64,
    /// Part of `error_px` that no motion can remove, px: noise and calibration error; NaN while the law does not drive.
    pub residual_px: f64,
    /// Distance of the gripper's origin from the goal by the daemon's estimate, m; NaN without a goal.
    pub distance_m: f64,
    /// Angle to the goal by the daemon's estimate, rad; NaN without a goal.
    pub angle_rad: f64,
    /// Condition number of the stacked interaction matrices (unit-scaled); NaN while the law does not drive.
    pub condition: f64,
    /// Fraction of the full speed in force, 0 to 1 (age of data, marks, singularity, limits); not the gain of the law.
    pub gain: f64,
    /// Number of marks of the gripper.
    pub mark_count: u32,
    /// Number of marks seen, left and right.
    pub marks_seen: [u32; 2],
    /// Log lines lost because the log's stream is blocked, full or closed.
    pub log_lost: u32,
    /// Pixel of each mark by view and mark index, px; NaN where not seen.
    pub marks: [[[f32; 2]; TELEMETRY_MARKS]; 2],
    /// Goal of each mark by view and mark index, px; NaN where there is none.
    pub goals: [[[f32; 2]; TELEMETRY_MARKS]; 2],
    /// Delay of the command thread's wake-up.
    pub wakeup_us: Percentiles,
    /// Computing time of a cycle of the command thread.
    pub compute_us: Percentiles,
    /// Time from the exposure of a pair to the first command that used it.
    pub frame_to_command_us: Percentiles,
    /// Time from a command to its echo by the control script.
    pub round_trip_us: Percentiles,
    /// Code and cause of the latched fault or of the last hold, UTF-8, zero-padded.
    pub cause: [u8; TELEMETRY_TEXT],
}

impl Default for TelemetrySample {
    fn default() -> Self {
        Self {
            magic: TELEMETRY_MAGIC,
            layout_version: TELEMETRY_VERSION,
            sequence: 0,
            stamp_ns: 0,
            state: 0,
            fault: 0,
            phase: 0,
            views: 0,
            ticks: 0,
            overruns: 0,
            frames: 0,
            frames_skipped: 0,
            frames_refused: 0,
            setpoint: 0,
            link: 0,
            robot_mode: -1,
            safety_bits: 0,
            limits_active: 0,
            q: [0.0; 6],
            qd: [0.0; 6],
            command: [0.0; 6],
            screw: [0.0; 6],
            left_from_gripper: [f64::NAN; 7],
            error_px: f64::NAN,
            residual_px: f64::NAN,
            distance_m: f64::NAN,
            angle_rad: f64::NAN,
            condition: f64::NAN,
            gain: 0.0,
            mark_count: 0,
            marks_seen: [0; 2],
            log_lost: 0,
            marks: [[[f32::NAN; 2]; TELEMETRY_MARKS]; 2],
            goals: [[[f32::NAN; 2]; TELEMETRY_MARKS]; 2],
            wakeup_us: Percentiles::default(),
            compute_us: Percentiles::default(),
            frame_to_command_us: Percentiles::default(),
            round_trip_us: Percentiles::default(),
            cause: [0; TELEMETRY_TEXT],
        }
    }
}

impl TelemetrySample {
    /// The cause text, up to its first zero byte; empty when it is not UTF-8.
    pub fn cause_text(&self) -> &str {
        let end = self.cause.iter().position(|&b| b == 0).unwrap_or(self.cause.len());
        std::str::from_utf8(&self.cause[..end]).unwrap_or("")
    }

    /// Sets the cause text, truncated at a character boundary to at most 255 bytes.
    pub fn set_cause(&mut self, text: &str) {
        self.cause = [0; TELEMETRY_TEXT];
        let mut end = text.len().min(TELEMETRY_TEXT - 1);
        while !text.is_char_boundary(end) {
            end -= 1;
        }
        self.cause[..end].copy_from_slice(&text.as_bytes()[..end]);
    }
}
