//! Servo in memory on a virtual clock: a perfect UR5e, eight marks, two cameras, from `arm` to convergence in
//! milliseconds.
//!
//! `cargo run --release -p graspd-rt --example servo_in_memory`
#![allow(clippy::unwrap_used)] // an example

use graspd_rt::arm::{ArmMode, Dh, Joints, Model, READY, RobotState};
use graspd_rt::cycle::{
    CommandCycle, CommandInput, CommandRequest, CycleConfig, CycleSettings, LinkStatus, RequestKind,
};
use graspd_rt::geom::{Camera, Distortion, Pose, Rig, Vec3, View};
use graspd_rt::gripper::{Gripper, MAX_MARKS, Mark};
use graspd_rt::mode::Mode;
use graspd_rt::online::{MarkObservation, RigHealth, Vision, VisionStatus};
use graspd_rt::setpoint::{Goal, SetPoint};
use nalgebra::{Matrix2, Matrix6};

/// The pixels of the marks with the gripper at `left_from_gripper`.
fn pixels(rig: &Rig, gripper: &Gripper, left_from_gripper: &Pose) -> [[Option<nalgebra::Vector2<f64>>; MAX_MARKS]; 2] {
    let point = |m: &Mark| (left_from_gripper * nalgebra::Point3::from(m.position)).coords;
    View::BOTH.map(|v| std::array::from_fn(|i| gripper.marks.get(i).and_then(|m| rig.project(v, &point(m)))))
}

fn state(now_ns: u64, q: Joints, qd: Joints, echo: i32) -> RobotState {
    RobotState {
        timestamp_s: now_ns as f64 * 1e-9,
        received_ns: now_ns,
        q,
        qd,
        target_q: q,
        target_qd: qd,
        robot_mode: 7,
        safety_status_bits: 1,
        robot_status_bits: 3,
        runtime_state: 2,
        speed_scaling: 1.0,
        target_speed_fraction: 1.0,
        digital_outputs: 0,
        tool: None,
        echo,
        script_state: 1,
        script_fault: 0,
        script_token: 0,
    }
}

/// Runs the loop to convergence; returns the virtual time that it took, seconds, and the final error of the pose,
/// metres.
pub(crate) fn run() -> (f64, f64) {
    let camera = Camera {
        width: 1280,
        height: 1024,
        fx: 1200.0,
        fy: 1200.0,
        cx: 640.0,
        cy: 512.0,
        distortion: Distortion::default(),
    };
    let rig = Rig { left: camera, right: camera, right_from_left: Pose::translation(-0.3, 0.0, 0.0) };
    let on_ring = |k: usize| {
        let (s, c) = (k as f64 * 0.785).sin_cos();
        let position = Vec3::new(0.06 * c, 0.06 * s, 0.01 * (k % 3) as f64);
        Mark { position, normal: -Vec3::z(), radius: 0.006, dark: true }
    };
    let gripper =
        Gripper { marks: (0..8).map(on_ring).collect(), flange_from_gripper: Pose::translation(0.0, 0.0, 0.15) };
    let dh = Dh::nominal(Model::Ur5e);
    let period_ns = 2_000_000;
    let settings = CycleSettings { period_ns, ..CycleSettings::default() };
    let config = CycleConfig { model: Model::Ur5e, dh, rig, gripper: gripper.clone(), settings };
    let mut cycle = CommandCycle::new(config).unwrap();

    // The rig is somewhere in front of the gripper. The loop is not told where in the robot's base.
    let start = Pose::translation(0.1, 0.0, 1.3);
    let left_from_base = start * dh.base_from_gripper(&READY, &gripper.flange_from_gripper).inverse();
    let goal = |pose: Pose| Goal { left_from_gripper: pose, marks: pixels(&rig, &gripper, &pose) };
    let pregrasp = start * Pose::translation(0.08, -0.03, 0.02);
    let grasp = pregrasp * Pose::translation(0.0, 0.0, 0.06);
    let setpoint = SetPoint {
        id: 1,
        pregrasp: goal(pregrasp),
        grasp: goal(grasp),
        object_centre: grasp.translation.vector,
        object_normal: -Vec3::z(),
        best_view: View::Left,
    };

    let (mut q, mut qd, mut echo) = (READY, [0.0; 6], 0);
    for k in 1..5_000_u64 {
        let now_ns = k * period_ns;
        let left_from_gripper = left_from_base * dh.base_from_gripper(&q, &gripper.flange_from_gripper);
        let observed = pixels(&rig, &gripper, &left_from_gripper).map(|view| {
            view.map(|p| p.map(|pixel| MarkObservation { pixel, covariance: Matrix2::identity() * 0.01, quality: 1.0 }))
        });
        let vision = Vision {
            sequence: k,
            capture_ns: [now_ns; 2],
            status: VisionStatus::Tracking,
            marks: observed,
            seen: [8; 2],
            left_from_gripper,
            covariance: Matrix6::identity() * 1e-8,
            residual_px: 0.1,
            inner_residual_px: 0.1,
            rig: RigHealth::default(),
        };
        let kind = match cycle.mode() {
            Mode::Tracking if k > 150 => Some(RequestKind::Arm),
            Mode::Armed => Some(RequestKind::Servo),
            Mode::Converged => {
                return (now_ns as f64 * 1e-9, (grasp.inverse() * left_from_gripper).translation.vector.norm());
            }
            _ => None,
        };
        let output = cycle.step(&CommandInput {
            now_ns,
            robot: Some(state(now_ns, q, qd, echo)),
            link: LinkStatus { connected: true, ..LinkStatus::default() },
            vision: (k % 8 == 0).then_some(&vision),
            request: kind.map(|kind| CommandRequest { id: k, kind }),
            setpoint: (k == 100).then_some(&setpoint),
            internal_fault: false,
        });
        qd = if output.command.mode == ArmMode::Velocity { output.command.rates } else { [0.0; 6] };
        q = std::array::from_fn(|i| q[i] + qd[i] * period_ns as f64 * 1e-9);
        echo = output.command.heartbeat;
    }
    panic!("not converged: {:?}", cycle.mode());
}

fn main() {
    let (seconds, error_m) = run();
    println!("converged after {seconds:.2} s of virtual time, {:.3} mm from the grasp", error_m * 1e3);
}
