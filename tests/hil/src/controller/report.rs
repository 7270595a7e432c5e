//! The values of one control step: computed once, read by every interface.

use crate::plant::Joints;

/// Values of one control step, SI units; poses are x, y, z and rotation vector in base.
#[derive(Clone, Debug, Default, PartialEq)]
#[expect(missing_docs, reason = "the fields have the names of the RTDE outputs")]
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

/// Faults in the reported values; the robot itself is unaffected.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReportFault {
    /// Joint whose position reads as NaN.
    pub nan_position: Option<usize>,
    /// Joint whose speed reads as NaN.
    pub nan_speed: Option<usize>,
    /// Added to the joint positions, rad.
    pub offset: Joints,
    /// Two joints that are exchanged.
    pub swapped: Option<(usize, usize)>,
}

impl Report {
    /// The report with a fault applied.
    pub(super) fn distorted(&self, fault: &ReportFault) -> Report {
        let mut reported = self.clone();
        for i in 0..6 {
            reported.actual_q[i] += fault.offset[i];
        }
        if let Some((a, b)) = fault.swapped
            && a < 6
            && b < 6
        {
            for v in [&mut reported.actual_q, &mut reported.actual_qd, &mut reported.target_q, &mut reported.target_qd]
            {
                v.swap(a, b);
            }
        }
        if let Some(v) = fault.nan_position.and_then(|i| reported.actual_q.get_mut(i)) {
            *v = f64::NAN;
        }
        if let Some(v) = fault.nan_speed.and_then(|i| reported.actual_qd.get_mut(i)) {
            *v = f64::NAN;
        }
        reported
    }
}
