//! Names, parameters and defaults of the built-in functions, and the binding of arguments.

use super::arithmetic::Outcome;
use super::value::Value;

/// Parameters: `name` is required, `name=default` optional; `name=?` is optional without a default.
const SIGNATURES: &[(&str, &str)] = &[
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
    let (_, spec) = SIGNATURES.iter().find(|(n, _)| *n == function)?;
    let parameters: Vec<(&str, Option<&str>)> = spec
        .split_whitespace()
        .map(|p| p.split_once('=').map_or((p, None), |(name, default)| (name, Some(default))))
        .collect();
    Some(bind_to(function, &parameters, given, names))
}

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
                .position(|(p, _)| p == n)
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
        for (i, (name, spec)) in SIGNATURES.iter().enumerate() {
            assert!(SIGNATURES.iter().skip(i + 1).all(|(n, _)| n != name), "{name}");
            for p in spec.split_whitespace() {
                if let Some((_, d)) = p.split_once('=') {
                    assert!(default(d).is_some(), "{name} {p}");
                }
            }
        }
    }
}
