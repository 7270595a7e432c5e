//! The functions of UR's script manual (software 5.x): implemented, accepted without effect, or refused at upload.
//!
//! docs/MOCK-UR.md lists the second and the third group; a test compares it with these tables.

use super::arithmetic::Outcome;
use super::value::Value;

/// Functions that are implemented, with their parameters: `name` is required, `name=default` optional; `name=?` is
/// optional without a default.
const IMPLEMENTED: &[(&str, &str)] = &[
    // Motion; defaults of the script manual.
    ("movej", "q a=1.4 v=1.05 t=0 r=0"),
    ("movel", "pose a=1.2 v=0.25 t=0 r=0"),
    ("movep", "pose a=1.2 v=0.25 r=0"),
    ("movec", "pose_via pose_to a=1.2 v=0.25 r=0 mode=0"),
    ("servoj", "q a=0 v=0 t=? lookahead_time=0.1 gain=300"),
    ("servoc", "pose a=1.2 v=0.25 r=0"),
    ("speedj", "qd a=1.4 t=0"),
    ("speedl", "xd a=1.4 t=0 aRot=0"),
    ("stopj", "a"),
    ("stopl", "a aRot=0"),
    ("force_mode", "task_frame selection_vector wrench type limits"),
    ("end_force_mode", ""),
    ("force_mode_set_damping", "damping"),
    ("force_mode_set_gain_scaling", "scaling"),
    ("zero_ftsensor", ""),
    ("interpreter_mode", "clearQueueOnEnter=True clearOnEnd=True"),
    ("end_interpreter", ""),
    ("clear_interpreter", ""),
    // Encoders: two counters that scripts set.
    ("encoder_enable_pulse_decode", "encoder_index decoder_type A B"),
    ("encoder_enable_set_tick_count", "encoder_index range_id"),
    ("encoder_get_tick_count", "encoder_index"),
    ("encoder_set_tick_count", "encoder_index count"),
    ("encoder_unwind_delta_tick_count", "encoder_index delta_tick_count"),
    ("get_conveyor_tick_count", ""),
    ("set_conveyor_tick_count", "tick_count absolute_encoder_resolution=0"),
    // Modbus signals, whose values a test sets on the control port.
    ("modbus_add_signal", "IP slave_number signal_address signal_type signal_name sequential_mode=False"),
    ("modbus_delete_signal", "signal_name"),
    ("modbus_get_signal_status", "signal_name is_secondary_program=False"),
    ("modbus_set_output_register", "signal_name register_value is_secondary_program=False"),
    ("modbus_set_output_signal", "signal_name digital_value is_secondary_program=False"),
    // Remote procedure calls.
    ("rpc_factory", "type url"),
    // Registers.
    ("read_input_integer_register", "address"),
    ("read_input_float_register", "address"),
    ("read_input_boolean_register", "address"),
    ("read_output_integer_register", "address"),
    ("read_output_float_register", "address"),
    ("read_output_boolean_register", "address"),
    ("write_output_integer_register", "address value"),
    ("write_output_float_register", "address value"),
    ("write_output_boolean_register", "address value"),
    // Time and threads.
    ("sync", ""),
    ("sleep", "t"),
    ("get_steptime", ""),
    // Kinematics.
    ("get_forward_kin", "q=? tcp=?"),
    ("get_inverse_kin", "x qnear=? maxPositionError=1e-10 maxOrientationError=1e-10 tcp=?"),
    ("get_inverse_kin_has_solution", "pose qnear=? maxPositionError=1e-10 maxOrientationError=1e-10 tcp=?"),
    ("get_jacobian", "q=? tcp=?"),
    // State.
    ("get_actual_tcp_pose", ""),
    ("get_target_tcp_pose", ""),
    ("get_target_tcp_pose_along_path", ""),
    ("get_target_tcp_speed_along_path", ""),
    ("get_target_waypoint", ""),
    ("get_actual_tool_flange_pose", ""),
    ("get_actual_tcp_speed", ""),
    ("get_target_tcp_speed", ""),
    ("get_actual_joint_positions", ""),
    ("get_joint_positions", ""),
    ("get_actual_joint_positions_history", "steps=0"),
    ("get_target_joint_accelerations", ""),
    ("get_target_joint_positions", ""),
    ("get_actual_joint_speeds", ""),
    ("get_target_joint_speeds", ""),
    ("get_joint_torques", ""),
    ("get_tcp_force", ""),
    ("get_tcp_offset", ""),
    ("get_target_payload", ""),
    ("get_target_payload_cog", ""),
    ("get_target_payload_inertia", ""),
    ("is_steady", ""),
    ("force", ""),
    ("is_within_safety_limits", "pose qnear=?"),
    ("tool_contact", "direction=?"),
    ("get_freedrive_status", ""),
    ("get_joint_temp", "j"),
    ("get_controller_temp", ""),
    ("get_tool_current", ""),
    ("get_tool_accelerometer_reading", ""),
    // Settings that affect the plant.
    ("set_tcp", "pose tcp_name=''"),
    ("set_payload", "m cog=?"),
    ("set_payload_mass", "m"),
    ("set_payload_cog", "CoG"),
    ("set_target_payload", "m cog=? inertia=? transition_time=0"),
    ("set_tool_voltage", "voltage"),
    ("powerdown", ""),
    ("rtde_set_watchdog", "variable_name min_frequency action='pause'"),
    ("protective_stop", ""),
    // Inputs and outputs.
    ("get_standard_digital_in", "n"),
    ("get_standard_digital_out", "n"),
    ("get_configurable_digital_in", "n"),
    ("get_configurable_digital_out", "n"),
    ("get_tool_digital_in", "n"),
    ("get_tool_digital_out", "n"),
    ("get_digital_in", "n"),
    ("get_digital_out", "n"),
    ("set_standard_digital_out", "n b"),
    ("set_configurable_digital_out", "n b"),
    ("set_tool_digital_out", "n b"),
    ("set_digital_out", "n b"),
    ("get_standard_analog_in", "n"),
    ("get_standard_analog_out", "n"),
    ("get_analog_out", "n"),
    ("read_port_bit", "address"),
    ("read_port_register", "address"),
    ("write_port_bit", "address value"),
    ("write_port_register", "address value"),
    ("get_tool_analog_in", "n"),
    ("set_standard_analog_out", "n f"),
    ("get_analog_in", "n"),
    ("set_analog_out", "n f"),
    ("get_flag", "n"),
    ("set_flag", "n b"),
    // Pendant.
    ("textmsg", "s1 s2=''"),
    ("popup", "s title='Popup' warning=False error=False blocking=False"),
    // Sockets.
    ("socket_open", "address port socket_name='socket_0'"),
    ("socket_close", "socket_name='socket_0'"),
    ("socket_send_int", "value socket_name='socket_0'"),
    ("socket_send_byte", "value socket_name='socket_0'"),
    ("socket_send_string", "str socket_name='socket_0'"),
    ("socket_send_line", "str socket_name='socket_0'"),
    ("socket_read_binary_integer", "number socket_name='socket_0' timeout=2"),
    ("socket_read_byte_list", "number socket_name='socket_0' timeout=2"),
    ("socket_read_ascii_float", "number socket_name='socket_0' timeout=2"),
    ("socket_read_line", "socket_name='socket_0' timeout=2"),
    ("socket_read_string", "socket_name='socket_0' prefix='' suffix='' interpret_escape=False timeout=2"),
    ("socket_get_var", "name socket_name='socket_0' timeout=2"),
    ("socket_set_var", "name value socket_name='socket_0'"),
    // Mathematics.
    ("sin", "f"),
    ("cos", "f"),
    ("tan", "f"),
    ("asin", "f"),
    ("acos", "f"),
    ("atan", "f"),
    ("atan2", "x y"),
    ("sqrt", "f"),
    ("pow", "base exponent"),
    ("log", "b f"),
    ("floor", "f"),
    ("ceil", "f"),
    ("d2r", "d"),
    ("r2d", "r"),
    ("norm", "a"),
    ("normalize", "v"),
    ("length", "v"),
    ("get_list_length", "v"),
    ("size", "v"),
    ("transpose", "m"),
    ("inv", "m"),
    ("make_list", "length initial_value=0 capacity=?"),
    ("random", ""),
    ("binary_list_to_integer", "l"),
    ("integer_to_binary_list", "x"),
    // Poses.
    ("pose_trans", "p_from p_from_to"),
    ("pose_inv", "p_from"),
    ("pose_add", "p_1 p_2"),
    ("pose_sub", "p_to p_from"),
    ("pose_dist", "p_from p_to"),
    ("wrench_trans", "T_from_to w_from"),
    ("point_dist", "p_from p_to"),
    ("interpolate_pose", "p_from p_to alpha"),
    ("rotvec2rpy", "rotation_vector"),
    ("rpy2rotvec", "rpy_vector"),
    // Texts.
    ("to_str", "val"),
    ("to_num", "str"),
    ("str_cat", "op1 op2"),
    ("str_len", "str"),
    ("str_empty", "str"),
    ("str_at", "src index"),
    ("str_sub", "src index len=?"),
    ("str_find", "src target start_from=0"),
];

/// Functions that are accepted without effect, with their parameters.
const WITHOUT_EFFECT: &[(&str, &str)] = &[
    ("conveyor_pulse_decode", "type A B"),
    ("enable_external_ft_sensor", "enable sensor_mass=0 sensor_measuring_offset=? sensor_cog=?"),
    ("end_freedrive_mode", ""),
    ("end_teach_mode", ""),
    ("freedrive_mode", "freeAxes=? feature=?"),
    ("freedrive_mode_no_incorrect_payload_check", ""),
    ("ft_rtde_input_enable", "enable sensor_mass=0 sensor_measuring_offset=? sensor_cog=?"),
    ("modbus_set_digital_input_action", "signal_name action"),
    ("modbus_set_runstate_dependent_choice", "signal_name runstate_choice"),
    ("modbus_set_signal_update_frequency", "signal_name update_frequency"),
    ("modbus_set_signal_watchdog", "signal_name new_timeout_in_sec"),
    ("pause_on_error_code", "code argument=?"),
    ("position_deviation_warning", "enabled threshold=0.8"),
    ("reset_revolution_counter", "qNear=?"),
    ("set_analog_inputrange", "port range"),
    ("set_analog_outputdomain", "port domain"),
    ("set_configurable_digital_input_action", "port action"),
    ("set_gp_boolean_input_action", "port action"),
    ("set_gravity", "d"),
    ("set_input_actions_to_default", ""),
    ("set_runstate_configurable_digital_output_to_value", "outputId state"),
    ("set_runstate_gp_boolean_output_to_value", "outputId state"),
    ("set_runstate_outputs", "outputs"),
    ("set_runstate_standard_analog_output_to_value", "outputId state"),
    ("set_runstate_standard_digital_output_to_value", "outputId state"),
    ("set_runstate_tool_digital_output_to_value", "outputId state"),
    ("set_safety_mode_transition_hardness", "type"),
    ("set_standard_analog_input_domain", "port domain"),
    ("set_standard_digital_input_action", "port action"),
    ("set_tool_analog_input_domain", "port domain"),
    ("set_tool_communication", "enabled baud_rate parity stop_bits rx_idle_chars tx_idle_chars"),
    ("set_tool_digital_input_action", "port action"),
    ("set_tool_digital_output_mode", "n mode"),
    ("set_tool_output_mode", "mode"),
    ("teach_mode", ""),
];

/// Functions of the manual that are refused at upload, because ignoring them would change the motion or the result.
const REFUSED: &[&str] = &[
    "direct_torque",
    "end_screw_driving",
    "get_coriolis_and_centrifugal_torques",
    "get_euromap_input",
    "get_euromap_output",
    "get_jacobian_time_derivative",
    "get_mass_matrix",
    "mc_add_circular",
    "mc_add_linear",
    "mc_add_path",
    "mc_get_target_rtcp_speed",
    "mc_initialize",
    "mc_load_path",
    "mc_run_motion",
    "mc_set_pcs",
    "mc_set_speed_factor",
    "modbus_send_custom_command",
    "optimovej",
    "optimovel",
    "path_offset_disable",
    "path_offset_enable",
    "path_offset_get",
    "path_offset_set",
    "path_offset_set_alpha_filter",
    "path_offset_set_max_offset",
    "screw_driving",
    "set_euromap_input_action",
    "set_euromap_output",
    "set_euromap_runstate_dependent_choice",
    "set_pos",
    "stop_conveyor_tracking",
    "track_conveyor_circular",
    "track_conveyor_linear",
];

/// What the mock does with a function.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Support {
    Implemented,
    WithoutEffect,
    Refused,
    Unknown,
}

/// What the mock does with function `name`.
pub(crate) fn support(name: &str) -> Support {
    let in_table = |table: &[(&str, &str)]| table.iter().any(|(n, _)| *n == name);
    if in_table(IMPLEMENTED) {
        Support::Implemented
    } else if in_table(WITHOUT_EFFECT) {
        Support::WithoutEffect
    } else if REFUSED.contains(&name) {
        Support::Refused
    } else {
        Support::Unknown
    }
}

/// Names of the functions that are accepted without effect.
pub fn accepted_without_effect() -> impl Iterator<Item = &'static str> {
    WITHOUT_EFFECT.iter().map(|(name, _)| *name)
}

/// Names of the documented functions that are refused at upload.
pub fn refused() -> impl Iterator<Item = &'static str> {
    REFUSED.iter().copied()
}

fn default(text: &str) -> Option<Value> {
    match text {
        "?" => Some(Value::None),
        "True" => Some(Value::Bool(true)),
        "False" => Some(Value::Bool(false)),
        _ => {
            if let Some(s) = text.strip_prefix('\'') {
                return Some(Value::Str(s.trim_end_matches('\'').to_owned()));
            }
            text.parse().map(Value::Int).or_else(|_| text.parse().map(Value::Float)).ok()
        }
    }
}

/// Arguments in the order of the parameters, with defaults filled in; `None` if there is no built-in of this name.
pub(crate) fn bind(function: &str, given: Vec<Value>, names: &[Option<String>]) -> Option<Outcome<Vec<Value>>> {
    let (_, spec) = IMPLEMENTED.iter().chain(WITHOUT_EFFECT).find(|(n, _)| *n == function)?;
    let parameters: Vec<(&str, Option<&str>)> = spec
        .split_whitespace()
        .map(|p| p.split_once('=').map_or((p, None), |(name, default)| (name, Some(default))))
        .collect();
    Some(bind_to(function, &parameters, given, names))
}

/// Binds positional and named arguments. `t_min` is the name of `t` in manuals before software 3.0, which urx still
/// uses.
fn bind_to(
    function: &str,
    parameters: &[(&str, Option<&str>)],
    given: Vec<Value>,
    names: &[Option<String>],
) -> Outcome<Vec<Value>> {
    let mut slots: Vec<Option<Value>> = vec![None; parameters.len()];
    for (i, (value, name)) in given.into_iter().zip(names).enumerate() {
        let at = match name {
            Some(n) => parameters
                .iter()
                .position(|(p, _)| p == n || (n == "t_min" && *p == "t"))
                .ok_or_else(|| format!("'{function}' has no argument '{n}'"))?,
            None => i,
        };
        match slots.get_mut(at) {
            Some(slot @ None) => *slot = Some(value),
            Some(Some(_)) => return Err(format!("'{function}' is given argument {} twice", at + 1)),
            None => return Err(format!("'{function}' takes {} arguments at most", parameters.len())),
        }
    }
    slots
        .into_iter()
        .zip(parameters)
        .map(|(slot, (name, text))| {
            slot.or_else(|| text.and_then(default)).ok_or_else(|| format!("'{function}' needs argument '{name}'"))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_valid_and_names_are_unique() {
        let all: Vec<_> =
            IMPLEMENTED.iter().chain(WITHOUT_EFFECT).copied().chain(REFUSED.iter().map(|n| (*n, ""))).collect();
        for (i, (name, spec)) in all.iter().enumerate() {
            assert!(all.iter().skip(i + 1).all(|(n, _)| n != name), "{name}");
            for p in spec.split_whitespace() {
                if let Some((_, d)) = p.split_once('=') {
                    assert!(default(d).is_some(), "{name} {p}");
                }
            }
        }
    }
}
