//! What the controller tells about one step: computed once, read by every interface.

use crate::plant::Joints;

/// Values of one control step, SI units; poses are x, y, z and rotation vector in base.
#[derive(Clone, Debug, Default, PartialEq)]
#[expect(missing_docs, reason = "the fields carry the RTDE outputs' own names")]
pub struct Report {
    pub target_q: Joints,
    pub target_qd: Joints,
    pub target_qdd: Joints,
    pub target_moment: Joints,
    pub target_current: Joints,
    pub actual_q: Joints,
    pub actual_qd: Joints,
    pub actual_qdd: Joints,
    pub actual_current: Joints,
    pub actual_tcp_pose: [f64; 6],
    pub target_tcp_pose: [f64; 6],
    pub actual_tcp_speed: [f64; 6],
    pub target_tcp_speed: [f64; 6],
    pub tcp_force: [f64; 6],
    pub elbow_position: [f64; 3],
    pub elbow_velocity: [f64; 3],
    pub tool_acceleration: [f64; 3],
    pub speed_scaling: f64,
    pub momentum: f64,
    pub robot_current: f64,
}

/// How the report is distorted on command (faults B08, B10, B17).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReportFault {
    /// This joint's position reads as not a number.
    pub nan_position: Option<usize>,
    /// This joint's speed reads as not a number.
    pub nan_speed: Option<usize>,
    /// Added to the joint positions read, rad.
    pub offset: Joints,
    /// These two joints are told in each other's place.
    pub swapped: Option<(usize, usize)>,
}

impl Report {
    /// The same with a fault on it.
    pub(super) fn distorted(&self, fault: &ReportFault) -> Report {
        let mut told = self.clone();
        for i in 0..6 {
            told.actual_q[i] += fault.offset[i];
        }
        if let Some((a, b)) = fault.swapped
            && a < 6
            && b < 6
        {
            for v in [&mut told.actual_q, &mut told.actual_qd, &mut told.target_q, &mut told.target_qd] {
                v.swap(a, b);
            }
        }
        if let Some(v) = fault.nan_position.and_then(|i| told.actual_q.get_mut(i)) {
            *v = f64::NAN;
        }
        if let Some(v) = fault.nan_speed.and_then(|i| told.actual_qd.get_mut(i)) {
            *v = f64::NAN;
        }
        told
    }
}
