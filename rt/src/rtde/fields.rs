//! Every variable of the protocol: 406 outputs and 175 inputs, with their types.
//!
//! Register families are listed by rule, all other variables by name. A [`Field`] is an index into that list: it is
//! `Copy`, compares in one instruction, and [`Field::index`] can index an array of values.

use core::fmt;

use super::value::FieldType;
use FieldType::{Bool, Double, Int32, Uint8, Uint32, Uint64, Vector3d, Vector6Int32, Vector6d};

/// Direction of a variable.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Side {
    /// From the controller.
    Output,
    /// To the controller.
    Input,
}

/// Number of output variables.
pub const OUTPUT_COUNT: usize = count(OUTPUTS);

/// Number of input variables.
pub const INPUT_COUNT: usize = count(INPUTS);

/// A named variable of the controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Field {
    side: Side,
    index: u16,
}

impl Field {
    /// The output variable of this name.
    pub fn output(name: &str) -> Option<Field> {
        find(OUTPUTS, name).map(|index| Field { side: Side::Output, index })
    }

    /// The input variable of this name.
    pub fn input(name: &str) -> Option<Field> {
        find(INPUTS, name).map(|index| Field { side: Side::Input, index })
    }

    /// The variable of this name on `side`.
    pub fn find(side: Side, name: &str) -> Option<Field> {
        match side {
            Side::Output => Field::output(name),
            Side::Input => Field::input(name),
        }
    }

    /// Every variable of `side`, in the order of [`Field::index`].
    pub fn all(side: Side) -> impl ExactSizeIterator<Item = Field> + Clone {
        let n = match side {
            Side::Output => OUTPUT_COUNT,
            Side::Input => INPUT_COUNT,
        };
        (0..n as u16).map(move |index| Field { side, index })
    }

    /// Its direction.
    pub const fn side(self) -> Side {
        self.side
    }

    /// Index in the list of its side, below [`OUTPUT_COUNT`] or [`INPUT_COUNT`].
    pub const fn index(self) -> usize {
        self.index as usize
    }

    /// Its type.
    pub const fn kind(self) -> FieldType {
        self.family().0.kind
    }

    /// Its name without a register's number, and the number: `("input_int_register_", Some(24))`, `("timestamp",
    /// None)`.
    pub const fn stem(self) -> (&'static str, Option<u16>) {
        let (family, nth) = self.family();
        (family.stem, if family.count == 0 { None } else { Some(family.first + nth) })
    }

    /// The rule of this field, and its index in that rule. A `Field` is only created with an index inside the list, so
    /// the search ends with a match; the first rule is the fallback that the type system requires.
    const fn family(self) -> (&'static Family, u16) {
        let list = match self.side {
            Side::Output => OUTPUTS,
            Side::Input => INPUTS,
        };
        let mut rest = self.index;
        let mut i = 0;
        while i < list.len() {
            let n = list[i].len();
            if rest < n {
                return (&list[i], rest);
            }
            rest -= n;
            i += 1;
        }
        (&list[0], 0)
    }
}

impl fmt::Display for Field {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.stem() {
            (stem, Some(number)) => write!(f, "{stem}{number}"),
            (stem, None) => f.write_str(stem),
        }
    }
}

/// One name, or a range of numbered registers.
struct Family {
    stem: &'static str,
    /// Number of the first register.
    first: u16,
    /// Number of registers; zero for a plain name.
    count: u16,
    kind: FieldType,
}

impl Family {
    const fn len(&self) -> u16 {
        if self.count == 0 { 1 } else { self.count }
    }
}

const fn one(stem: &'static str, kind: FieldType) -> Family {
    Family { stem, first: 0, count: 0, kind }
}

const fn row(stem: &'static str, first: u16, count: u16, kind: FieldType) -> Family {
    Family { stem, first, count, kind }
}

const fn count(list: &[Family]) -> usize {
    let (mut n, mut i) = (0, 0);
    while i < list.len() {
        n += list[i].len() as usize;
        i += 1;
    }
    n
}

fn find(list: &'static [Family], name: &str) -> Option<u16> {
    let mut base = 0;
    for family in list {
        if family.count == 0 {
            if family.stem == name {
                return Some(base);
            }
        } else if let Some(number) = name.strip_prefix(family.stem).and_then(register_number)
            && (family.first..family.first + family.count).contains(&number)
        {
            return Some(base + number - family.first);
        }
        base += family.len();
    }
    None
}

/// A register's number in the controller's spelling: digits, no sign, no leading zero.
fn register_number(digits: &str) -> Option<u16> {
    let plain = digits == "0" || digits.starts_with(|c: char| c.is_ascii_digit() && c != '0');
    if plain { digits.parse().ok() } else { None }
}

const OUTPUTS: &[Family] = &[
    one("timestamp", Double),
    one("target_q", Vector6d),
    one("target_qd", Vector6d),
    one("target_qdd", Vector6d),
    one("target_current", Vector6d),
    one("target_moment", Vector6d),
    one("actual_q", Vector6d),
    one("actual_qd", Vector6d),
    one("actual_current", Vector6d),
    one("actual_current_window", Vector6d),
    one("actual_current_as_torque", Vector6d),
    one("joint_control_output", Vector6d),
    one("actual_TCP_pose", Vector6d),
    one("actual_TCP_speed", Vector6d),
    one("actual_TCP_force", Vector6d),
    one("target_TCP_pose", Vector6d),
    one("target_TCP_speed", Vector6d),
    one("tcp_offset", Vector6d),
    one("actual_TCP_acceleration", Vector6d),
    one("target_TCP_acceleration", Vector6d),
    one("joint_temperatures", Vector6d),
    one("actual_joint_voltage", Vector6d),
    one("ft_raw_wrench", Vector6d),
    one("wrench_calc_from_currents", Vector6d),
    one("payload_inertia", Vector6d),
    one("target_base_acceleration", Vector6d),
    one("target_base_wrench", Vector6d),
    one("actual_execution_time", Double),
    one("target_execution_time", Double),
    one("speed_scaling", Double),
    one("target_speed_fraction", Double),
    one("actual_momentum", Double),
    one("actual_main_voltage", Double),
    one("actual_robot_voltage", Double),
    one("actual_robot_current", Double),
    one("standard_analog_input0", Double),
    one("standard_analog_input1", Double),
    one("standard_analog_output0", Double),
    one("standard_analog_output1", Double),
    one("io_current", Double),
    one("actual_robot_energy_consumed", Double),
    one("actual_robot_braking_energy_dissipated", Double),
    one("euromap67_24V_voltage", Double),
    one("euromap67_24V_current", Double),
    one("tool_analog_input0", Double),
    one("tool_analog_input1", Double),
    one("tool_output_current", Double),
    one("tool_temperature", Double),
    one("tcp_force_scalar", Double),
    one("joint_position_deviation_ratio", Double),
    one("collision_detection_ratio", Double),
    one("payload", Double),
    one("actual_digital_input_bits", Uint64),
    one("actual_configurable_digital_input_bits", Uint64),
    one("actual_digital_output_bits", Uint64),
    one("actual_configurable_digital_output_bits", Uint64),
    one("control_step", Uint64),
    one("robot_mode", Int32),
    one("safety_mode", Int32),
    one("safety_status", Int32),
    one("encoder0_raw", Int32),
    one("encoder1_raw", Int32),
    one("tool_output_voltage", Int32),
    one("time_scale_source", Int32),
    one("joint_mode", Vector6Int32),
    one("actual_tool_accelerometer", Vector3d),
    one("elbow_position", Vector3d),
    one("elbow_velocity", Vector3d),
    one("payload_cog", Vector3d),
    one("target_gravity", Vector3d),
    one("runtime_state", Uint32),
    one("robot_status_bits", Uint32),
    one("safety_status_bits", Uint32),
    one("analog_io_types", Uint32),
    one("euromap67_input_bits", Uint32),
    one("euromap67_output_bits", Uint32),
    one("tool_mode", Uint32),
    one("tool_analog_input_types", Uint32),
    one("script_control_line", Uint32),
    one("tool_output_mode", Uint8),
    one("tool_digital_output0_mode", Uint8),
    one("tool_digital_output1_mode", Uint8),
    one("output_bit_registers0_to_31", Uint32),
    one("output_bit_registers32_to_63", Uint32),
    one("input_bit_registers0_to_31", Uint32),
    one("input_bit_registers32_to_63", Uint32),
    row("output_bit_register_", 64, 64, Bool),
    row("input_bit_register_", 64, 64, Bool),
    row("output_int_register_", 0, 48, Int32),
    row("input_int_register_", 0, 48, Int32),
    row("output_double_register_", 0, 48, Double),
    row("input_double_register_", 0, 48, Double),
];

const INPUTS: &[Family] = &[
    one("speed_slider_mask", Uint32),
    one("speed_slider_fraction", Double),
    one("standard_digital_output_mask", Uint8),
    one("standard_digital_output", Uint8),
    one("configurable_digital_output_mask", Uint8),
    one("configurable_digital_output", Uint8),
    one("tool_digital_output_mask", Uint8),
    one("tool_digital_output", Uint8),
    one("standard_analog_output_mask", Uint8),
    one("standard_analog_output_type", Uint8),
    one("standard_analog_output_0", Double),
    one("standard_analog_output_1", Double),
    one("external_force_torque", Vector6d),
    one("input_bit_registers0_to_31", Uint32),
    one("input_bit_registers32_to_63", Uint32),
    row("input_bit_register_", 64, 64, Bool),
    row("input_int_register_", 0, 48, Int32),
    row("input_double_register_", 0, 48, Double),
];

#[cfg(test)]
mod tests {
    use super::*;
    use core::fmt::Write;

    #[test]
    fn the_lists_are_complete_and_names_round_trip() {
        assert_eq!((OUTPUT_COUNT, INPUT_COUNT), (406, 175));
        for side in [Side::Output, Side::Input] {
            for (i, field) in Field::all(side).enumerate() {
                let mut name = heapless::String::<64>::new();
                write!(name, "{field}").unwrap();
                assert_eq!(field.index(), i);
                assert_eq!(Field::find(side, &name), Some(field), "{name}");
            }
        }
    }

    #[test]
    fn types_agree_with_the_manual() {
        for (name, kind) in [
            ("timestamp", Double),
            ("actual_q", Vector6d),
            ("joint_mode", Vector6Int32),
            ("safety_status_bits", Uint32),
            ("tool_output_mode", Uint8),
            ("payload_cog", Vector3d),
            ("actual_digital_output_bits", Uint64),
            ("output_bit_register_127", Bool),
            ("input_int_register_0", Int32),
            ("output_double_register_47", Double),
        ] {
            assert_eq!(Field::output(name).map(Field::kind), Some(kind), "{name}");
        }
        assert_eq!(Field::input("external_force_torque").map(Field::kind), Some(Vector6d));
    }

    #[test]
    fn similar_names_are_not_found() {
        for name in [
            "",
            "Timestamp",
            "timestamp ",
            "output_int_register_48",
            "output_int_register_",
            "output_int_register_+1",
            "output_int_register_01",
            "output_bit_register_63",
            "output_bit_register_128",
            "output_int_register_99999999999",
        ] {
            assert_eq!(Field::output(name), None, "{name}");
        }
        assert_eq!(Field::input("actual_q"), None);
    }
}
