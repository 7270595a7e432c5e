//! RTDE variables of the robot: the value of each output and the effect of each input.

use super::robot::Robot;
use graspd_rt::rtde::{Field, FieldType, Value};

/// Type and getter of an output; resolved once, when a recipe is set up.
#[derive(Clone, Copy, Debug)]
pub(super) struct Source {
    field: FieldType,
    get: Getter,
}

type Getter = fn(&Robot, usize) -> Value;

/// One output of a recipe: its source and its register number.
#[derive(Clone, Copy, Debug)]
pub(super) struct Output {
    source: Source,
    number: usize,
}

impl Output {
    /// Looks up the source of `field`.
    pub(super) fn new(field: Field) -> Output {
        let (stem, number) = field.stem();
        Output { source: Source { field: field.kind(), get: getter(stem) }, number: number.map_or(0, usize::from) }
    }

    /// The present value; zero of the field's type for an output that this robot does not have.
    pub(super) fn value(&self, robot: &Robot) -> Value {
        let value = (self.source.get)(robot, self.number);
        if value.kind() == self.source.field { value } else { self.source.field.zero() }
    }
}

fn getter(stem: &'static str) -> Getter {
    use Value::{Bool, Double, Int32, Uint8, Uint32, Uint64, Vector3d, Vector6Int32, Vector6d};
    match stem {
        "timestamp" => |r, _| Double(r.clock_s),
        "target_q" => |r, _| Vector6d(r.report.target_q),
        "target_qd" => |r, _| Vector6d(r.report.target_qd),
        "target_qdd" => |r, _| Vector6d(r.report.target_qdd),
        "target_current" => |r, _| Vector6d(r.report.target_current),
        "target_moment" => |r, _| Vector6d(r.report.target_moment),
        "actual_q" => |r, _| Vector6d(r.report.actual_q),
        "actual_qd" => |r, _| Vector6d(r.report.actual_qd),
        "actual_current" => |r, _| Vector6d(r.report.actual_current),
        "actual_current_window" => |_, _| Vector6d([4.0; 6]),
        "actual_current_as_torque" => |r, _| Vector6d(r.report.target_moment),
        "joint_control_output" => |r, _| Vector6d(r.report.target_current),
        "actual_TCP_pose" => |r, _| Vector6d(r.report.actual_tcp_pose),
        "actual_TCP_speed" => |r, _| Vector6d(r.report.actual_tcp_speed),
        "actual_TCP_force" => |r, _| Vector6d(r.report.tcp_force),
        "target_TCP_pose" => |r, _| Vector6d(r.report.target_tcp_pose),
        "target_TCP_speed" => |r, _| Vector6d(r.report.target_tcp_speed),
        "tcp_offset" => |r, _| Vector6d(r.tcp),
        "actual_TCP_acceleration" | "target_TCP_acceleration" => |r, _| {
            let [x, y, z] = r.report.tool_acceleration;
            Vector6d([x, y, z - 9.82, 0.0, 0.0, 0.0])
        },
        "joint_temperatures" => |r, _| Vector6d(r.report.actual_current.map(|i| 28.0 + 0.5 * i.abs())),
        "actual_joint_voltage" => |r, _| Vector6d([if r.mode.is_powered() { 47.9 } else { 0.0 }; 6]),
        "ft_raw_wrench" | "wrench_calc_from_currents" => |r, _| Vector6d(r.report.tcp_force),
        "payload_inertia" => |r, _| Vector6d(r.payload.inertia),
        "actual_execution_time" => |_, _| Double(0.45),
        "target_execution_time" => |r, _| Double(r.dt * 1e3),
        "speed_scaling" => |r, _| Double(r.report.speed_scaling),
        "target_speed_fraction" => |r, _| Double(r.slider),
        "actual_momentum" => |r, _| Double(r.report.momentum),
        "actual_main_voltage" => |_, _| Double(48.1),
        "actual_robot_voltage" => |r, _| Double(if r.mode.is_powered() { 47.9 } else { 0.0 }),
        "actual_robot_current" => |r, _| Double(r.report.robot_current),
        "standard_analog_input0" => |r, _| Double(r.signals.analog_in[0]),
        "standard_analog_input1" => |r, _| Double(r.signals.analog_in[1]),
        "standard_analog_output0" => |r, _| Double(r.signals.analog_out[0]),
        "standard_analog_output1" => |r, _| Double(r.signals.analog_out[1]),
        "io_current" => |_, _| Double(0.03),
        "actual_robot_energy_consumed" => |r, _| Double(r.report.robot_current * 48.0 * r.steps as f64 * r.dt),
        "tool_output_current" => |_, _| Double(0.01),
        "tool_temperature" => |_, _| Double(30.0),
        "tcp_force_scalar" => |r, _| {
            let [x, y, z, ..] = r.report.tcp_force;
            Double((x * x + y * y + z * z).sqrt())
        },
        "joint_position_deviation_ratio" => |r, _| {
            let worst = (0..6).map(|i| (r.report.target_q[i] - r.report.actual_q[i]).abs()).fold(0.0, f64::max);
            Double(worst / 0.087)
        },
        "payload" => |r, _| Double(r.payload.mass),
        "actual_digital_input_bits" => |r, _| Uint64(r.signals.digital_in),
        "actual_configurable_digital_input_bits" => |r, _| Uint64(r.signals.digital_in >> 8 & 0xff),
        "actual_digital_output_bits" => |r, _| Uint64(r.signals.digital_out),
        "actual_configurable_digital_output_bits" => |r, _| Uint64(r.signals.digital_out >> 8 & 0xff),
        "control_step" => |r, _| Uint64(r.steps),
        "robot_mode" => |r, _| Int32(r.mode as i32),
        "safety_mode" | "safety_status" => |r, _| Int32(r.safety as i32),
        "tool_output_voltage" => |r, _| Int32(r.signals.tool_voltage),
        "joint_mode" => |r, _| Vector6Int32([r.mode.joint_mode(); 6]),
        "actual_tool_accelerometer" => |r, _| Vector3d(r.report.tool_acceleration),
        "elbow_position" => |r, _| Vector3d(r.report.elbow_position),
        "elbow_velocity" => |r, _| Vector3d(r.report.elbow_velocity),
        "payload_cog" => |r, _| Vector3d(r.payload.cog),
        "target_gravity" => |_, _| Vector3d([0.0, 0.0, 9.82]),
        "runtime_state" => |r, _| Uint32(r.runtime as u32),
        "robot_status_bits" => |r, _| Uint32(r.status_bits()),
        "safety_status_bits" => |r, _| Uint32(r.safety.bits()),
        "analog_io_types" => |r, _| Uint32(r.signals.analog_types),
        "tool_mode" => |r, _| Uint32(r.mode.joint_mode() as u32),
        "tool_output_mode" => |_, _| Uint8(0),
        "tool_digital_output0_mode" | "tool_digital_output1_mode" => |_, _| Uint8(1),
        "output_bit_registers0_to_31" => |r, _| Uint32(r.outputs.word(0)),
        "output_bit_registers32_to_63" => |r, _| Uint32(r.outputs.word(1)),
        "input_bit_registers0_to_31" => |r, _| Uint32(r.inputs.word(0)),
        "input_bit_registers32_to_63" => |r, _| Uint32(r.inputs.word(1)),
        "output_bit_register_" => |r, n| Bool(r.outputs.bit(n)),
        "input_bit_register_" => |r, n| Bool(r.inputs.bit(n)),
        "output_int_register_" => |r, n| Int32(r.outputs.ints.get(n).copied().unwrap_or(0)),
        "input_int_register_" => |r, n| Int32(r.inputs.ints.get(n).copied().unwrap_or(0)),
        "output_double_register_" => |r, n| Double(r.outputs.doubles.get(n).copied().unwrap_or(0.0)),
        "input_double_register_" => |r, n| Double(r.inputs.doubles.get(n).copied().unwrap_or(0.0)),
        // Euromap, encoders, inverse dynamics: not simulated. The type mismatch makes `value` return zero.
        _ => |_, _| Bool(false),
    }
}

/// Fields of one input package that belong together: masks and the values they select.
#[derive(Default)]
struct Masked {
    standard: (u8, u8),
    configurable: (u8, u8),
    tool: (u8, u8),
    analog_mask: u8,
    analog_type: u8,
    analog: [f64; 2],
    slider_mask: u32,
    slider: f64,
}

impl Robot {
    /// `robot_status_bits`.
    pub fn status_bits(&self) -> u32 {
        u32::from(self.mode.is_powered()) | u32::from(self.is_program_running()) << 1
    }

    /// Applies one input package. Registers keep NaN and infinite values as the client wrote them.
    pub fn apply_inputs(&mut self, values: &[(Field, Value)]) {
        let mut masked = Masked::default();
        for &(field, value) in values {
            let (stem, number) = field.stem();
            let n = number.map_or(0, usize::from);
            match (stem, value) {
                ("input_int_register_", Value::Int32(v)) => {
                    if let Some(r) = self.inputs.ints.get_mut(n) {
                        *r = v;
                    }
                }
                ("input_double_register_", Value::Double(v)) => {
                    if let Some(r) = self.inputs.doubles.get_mut(n) {
                        *r = v;
                    }
                }
                ("input_bit_register_", Value::Bool(v)) => self.inputs.set_bit(n, v),
                ("input_bit_registers0_to_31", Value::Uint32(v)) => self.inputs.set_word(0, v),
                ("input_bit_registers32_to_63", Value::Uint32(v)) => self.inputs.set_word(1, v),
                ("external_force_torque", Value::Vector6d(v)) => self.external_wrench = v,
                ("standard_digital_output_mask", Value::Uint8(v)) => masked.standard.0 = v,
                ("standard_digital_output", Value::Uint8(v)) => masked.standard.1 = v,
                ("configurable_digital_output_mask", Value::Uint8(v)) => masked.configurable.0 = v,
                ("configurable_digital_output", Value::Uint8(v)) => masked.configurable.1 = v,
                ("tool_digital_output_mask", Value::Uint8(v)) => masked.tool.0 = v & 3,
                ("tool_digital_output", Value::Uint8(v)) => masked.tool.1 = v,
                ("standard_analog_output_mask", Value::Uint8(v)) => masked.analog_mask = v,
                ("standard_analog_output_type", Value::Uint8(v)) => masked.analog_type = v,
                ("standard_analog_output_0", Value::Double(v)) => masked.analog[0] = v,
                ("standard_analog_output_1", Value::Double(v)) => masked.analog[1] = v,
                ("speed_slider_mask", Value::Uint32(v)) => masked.slider_mask = v,
                ("speed_slider_fraction", Value::Double(v)) => masked.slider = v,
                _ => {}
            }
            self.watchdogs.feed_field(field, self.clock_s);
        }
        self.apply_masked(&masked);
    }

    fn apply_masked(&mut self, m: &Masked) {
        self.signals.set_outputs(0, m.standard.0, m.standard.1);
        self.signals.set_outputs(8, m.configurable.0, m.configurable.1);
        self.signals.set_outputs(16, m.tool.0, m.tool.1);
        for i in 0..2 {
            if m.analog_mask >> i & 1 == 1 && m.analog[i].is_finite() {
                let voltage = m.analog_type >> i & 1 == 1;
                self.signals.analog_types = self.signals.analog_types & !(1 << (2 + i)) | u32::from(voltage) << (2 + i);
                crate::urscript::Host::set_analog_out(self, i, m.analog[i].clamp(0.0, 1.0));
            }
        }
        if m.slider_mask != 0 && m.slider.is_finite() {
            self.slider = m.slider.clamp(0.0, 1.0);
        }
    }
}
