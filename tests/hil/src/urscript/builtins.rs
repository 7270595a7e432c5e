//! Built-in functions that access the controller: registers, motion, kinematics, state, outputs, pendant.

use super::arithmetic::Outcome;
use super::error::HostError;
use super::functions::{Support, bind, support};
use super::host::{
    Bank, ForceMode, Host, KinematicsQuery, Motion, MotionStatus, OutputKind, Popup, Target, WatchdogAction,
};
use super::pure::{boolean, finite, index, int32, number, pose, six, text};
use super::sockets::SocketBuffers;
use super::value::Value;
use super::wait::{Flow, Wait};
use super::{pure, rpc, sockets};

/// Integer and float registers of either bank.
const REGISTERS: usize = 48;
/// Boolean registers of either bank.
const BITS: usize = 128;

fn refused(e: HostError) -> String {
    e.to_string()
}

/// Begins a call. `free` is false while another thread's motion is under way.
pub(crate) fn begin(
    name: &str,
    given: Vec<Value>,
    names: &[Option<String>],
    free: bool,
    host: &mut dyn Host,
    buffers: &mut SocketBuffers,
) -> Outcome<Flow> {
    if given.contains(&Value::None) {
        return Err(format!("an argument of '{name}' has no value"));
    }
    let Some(bound) = bind(name, given, names) else {
        return Err(HostError::UnknownFunction(name.to_owned()).to_string());
    };
    let a = bound?;
    if support(name) == Support::WithoutEffect {
        host.setting(name, &a).map_err(refused)?;
        return Ok(Flow::Value(Value::None));
    }
    if let Some(value) = pure::call(name, &a) {
        return value.map(Flow::Value);
    }
    if let Some(flow) = sockets::call(name, &a, host, buffers) {
        return flow;
    }
    if let Some(motion) = motion(name, &a, host) {
        if !free {
            return Err("another thread is already controlling the robot".to_owned());
        }
        host.motion_start(&motion?).map_err(refused)?;
        return Ok(Flow::Wait(Wait::Motion));
    }
    let none = Value::None;
    let x = a.first().unwrap_or(&none);
    match name {
        "sync" => Ok(Flow::Wait(Wait::Steps(1))),
        "sleep" => {
            let seconds = finite(x)?;
            if seconds <= 0.0 {
                return Ok(Flow::Value(Value::None));
            }
            // The small margin keeps 0.1 s at 2 ms from being rounded up to 51 steps.
            Ok(Flow::Wait(Wait::Steps((seconds / host.step_time() - 1e-6).ceil().clamp(1.0, 1e9) as u32)))
        }
        "popup" => {
            let popup = Popup {
                text: x.to_string(),
                title: text(a.get(1).unwrap_or(&none))?.to_owned(),
                warning: boolean(a.get(2).unwrap_or(&none))?,
                error: boolean(a.get(3).unwrap_or(&none))?,
                blocking: boolean(a.get(4).unwrap_or(&none))?,
            };
            host.popup(&popup);
            Ok(if popup.blocking { Flow::Wait(Wait::Popup) } else { Flow::Value(Value::None) })
        }
        "rpc_factory" => rpc::factory(text(x)?, text(a.get(1).unwrap_or(&none))?).map(Flow::Value),
        _ => immediate(name, &a, host).map(Flow::Value),
    }
}

/// Continues a blocking call, once in each control step.
pub(crate) fn resume(wait: Wait, host: &mut dyn Host, buffers: &mut SocketBuffers) -> Outcome<Flow> {
    match wait {
        Wait::Steps(n) if n > 1 => Ok(Flow::Wait(Wait::Steps(n - 1))),
        Wait::Motion => match host.motion_poll() {
            MotionStatus::Running => Ok(Flow::Wait(Wait::Motion)),
            MotionStatus::Done => Ok(Flow::Value(Value::None)),
            MotionStatus::Failed(why) => Err(why),
        },
        Wait::Popup if host.popup_open() => Ok(Flow::Wait(Wait::Popup)),
        Wait::Socket(wait) => sockets::resume(wait, host, buffers),
        Wait::Remote(call) => rpc::resume(call, host),
        Wait::Steps(_) | Wait::Popup | Wait::Thread(_) | Wait::Interpreter => Ok(Flow::Value(Value::None)),
    }
}

fn target(v: &Value) -> Outcome<Target> {
    let values = six(v)?;
    Ok(if matches!(v, Value::Pose(_)) { Target::Pose(values) } else { Target::Joints(values) })
}

/// The motion of a motion call; `None` if `name` is not one.
fn motion(name: &str, a: &[Value], host: &dyn Host) -> Option<Outcome<Motion>> {
    let none = Value::None;
    let at = |i: usize| a.get(i).unwrap_or(&none);
    let n = |i: usize| finite(at(i));
    let make = || -> Outcome<Option<Motion>> {
        Ok(Some(match name {
            "movej" => Motion::MoveJ { target: target(at(0))?, a: n(1)?, v: n(2)?, t: n(3)?, r: n(4)? },
            "movel" => Motion::MoveL { target: target(at(0))?, a: n(1)?, v: n(2)?, t: n(3)?, r: n(4)? },
            "movep" => Motion::MoveP { target: target(at(0))?, a: n(1)?, v: n(2)?, r: n(3)? },
            "movec" => {
                let (via, to) = (target(at(0))?, target(at(1))?);
                Motion::MoveC { via, to, a: n(2)?, v: n(3)?, r: n(4)?, mode: int32(at(5))? }
            }
            "servoj" => {
                let t = if *at(3) == Value::None { host.step_time() } else { n(3)? };
                Motion::ServoJ { q: six(at(0))?, a: n(1)?, v: n(2)?, t, lookahead_time: n(4)?, gain: n(5)? }
            }
            "servoc" => Motion::ServoC { target: target(at(0))?, a: n(1)?, v: n(2)?, r: n(3)? },
            "speedj" => Motion::SpeedJ { qd: six(at(0))?, a: n(1)?, t: n(2)? },
            "speedl" => Motion::SpeedL { xd: six(at(0))?, a: n(1)?, t: n(2)?, a_rot: n(3)? },
            "stopj" => Motion::StopJ { a: n(0)? },
            "stopl" => Motion::StopL { a: n(0)?, a_rot: n(1)? },
            _ => return Ok(None),
        }))
    };
    make().map_err(|e| format!("{name}: {e}")).transpose()
}

fn optional_six(v: &Value) -> Outcome<Option<[f64; 6]>> {
    match v {
        Value::None => Ok(None),
        // UR's name of the active TCP.
        Value::Str(s) if s == "active_tcp" => Ok(None),
        other => six(other).map(Some),
    }
}

fn query(a: &[Value]) -> Outcome<KinematicsQuery> {
    let none = Value::None;
    let at = |i: usize| a.get(i).unwrap_or(&none);
    Ok(KinematicsQuery {
        pose: pose(at(0))?,
        near: optional_six(at(1))?,
        max_position_error: finite(at(2))?,
        max_orientation_error: finite(at(3))?,
        tcp: optional_six(at(4))?,
    })
}

/// Value of a function that returns a part of the arm's state; `None` if `name` is not one.
fn state(name: &str, host: &dyn Host) -> Option<Value> {
    Some(match name {
        "get_actual_tcp_pose" => Value::Pose(host.view().tcp_pose_actual),
        "get_target_tcp_pose" | "get_target_tcp_pose_along_path" => Value::Pose(host.view().tcp_pose_target),
        "get_target_waypoint" => Value::Pose(host.view().target_waypoint),
        "get_actual_tool_flange_pose" => Value::Pose(host.forward_kinematics(&host.view().q_actual, Some(&[0.0; 6]))),
        "get_actual_tcp_speed" => Value::Pose(host.view().tcp_speed_actual),
        "get_target_tcp_speed" | "get_target_tcp_speed_along_path" => Value::Pose(host.view().tcp_speed_target),
        "get_actual_joint_positions" | "get_joint_positions" => Value::floats(&host.view().q_actual),
        "get_target_joint_positions" => Value::floats(&host.view().q_target),
        "get_actual_joint_speeds" => Value::floats(&host.view().qd_actual),
        "get_target_joint_speeds" => Value::floats(&host.view().qd_target),
        "get_joint_torques" => Value::floats(&host.view().torques),
        "get_tcp_force" => Value::Pose(host.view().tcp_force),
        "force" => {
            let f = host.view().tcp_force;
            Value::Float(f.iter().take(3).map(|x| x * x).sum::<f64>().sqrt())
        }
        "get_tcp_offset" => Value::Pose(host.view().tcp_offset),
        "get_target_payload" => Value::Float(host.view().payload_mass),
        "get_target_payload_cog" => Value::floats(&host.view().payload_cog),
        "is_steady" => Value::Bool(host.view().steady),
        _ => return None,
    })
}

fn immediate(name: &str, a: &[Value], host: &mut dyn Host) -> Outcome {
    let none = Value::None;
    let [x, y, z] = [0, 1, 2].map(|i| a.get(i).unwrap_or(&none));
    if let Some(done) = register(name, x, y, host).or_else(|| signal(name, x, y, host)) {
        return done;
    }
    if let Some(value) = state(name, host) {
        return Ok(value);
    }
    let joints = |host: &dyn Host| -> Outcome<[f64; 6]> { Ok(optional_six(x)?.unwrap_or(host.view().q_actual)) };
    Ok(match name {
        "get_steptime" => Value::Float(host.step_time()),
        "get_forward_kin" => {
            let q = joints(host)?;
            Value::Pose(host.forward_kinematics(&q, optional_six(y)?.as_ref()))
        }
        "get_inverse_kin" => {
            let found = host.inverse_kinematics(&query(a)?);
            Value::floats(&found.ok_or("get_inverse_kin: no solution, the pose is out of reach")?)
        }
        "get_inverse_kin_has_solution" => Value::Bool(host.inverse_kinematics(&query(a)?).is_some()),
        "get_jacobian" => {
            let q = joints(host)?;
            let rows = host.jacobian(&q, optional_six(y)?.as_ref());
            Value::List(rows.iter().map(|r| Value::floats(r)).collect())
        }
        "textmsg" => {
            host.text_message(&format!("{x}{y}"));
            Value::None
        }
        "set_tcp" => {
            host.set_tcp(&pose(x)?);
            Value::None
        }
        "set_payload" => {
            let cog = if *y == Value::None { None } else { Some(three(y)?) };
            host.set_payload(finite(x)?, cog).map_err(refused)?;
            Value::None
        }
        "set_payload_mass" => {
            host.set_payload(finite(x)?, None).map_err(refused)?;
            Value::None
        }
        "set_payload_cog" => {
            let mass = host.view().payload_mass;
            host.set_payload(mass, Some(three(x)?)).map_err(refused)?;
            Value::None
        }
        "set_target_payload" => {
            let cog = if *y == Value::None { None } else { Some(three(y)?) };
            host.set_payload(finite(x)?, cog).map_err(refused)?;
            Value::None
        }
        "force_mode" => {
            host.force_mode(&force_mode(a)?).map_err(refused)?;
            Value::None
        }
        "end_force_mode" => {
            host.end_force_mode();
            Value::None
        }
        "protective_stop" => {
            host.protective_stop();
            Value::None
        }
        "rtde_set_watchdog" => {
            let action = match text(z)?.to_ascii_lowercase().as_str() {
                "pause" => WatchdogAction::Pause,
                "stop" => WatchdogAction::Stop,
                "ignore" => WatchdogAction::Ignore,
                other => return Err(format!("rtde_set_watchdog: '{other}' is not pause, stop or ignore")),
            };
            host.set_watchdog(text(x)?, finite(y)?, action).map_err(refused)?;
            Value::None
        }
        // Arguments are bound here; the host evaluates the function.
        _ => return host.call(name, a).map_err(refused),
    })
}

fn force_mode(a: &[Value]) -> Outcome<ForceMode> {
    let none = Value::None;
    let at = |i: usize| a.get(i).unwrap_or(&none);
    let selection = six(at(1)).map_err(|e| format!("force_mode: selection_vector: {e}"))?;
    let frame_type = int32(at(3))?;
    if !(1..=3).contains(&frame_type) {
        return Err(format!("force_mode: type {frame_type} is not 1, 2 or 3"));
    }
    Ok(ForceMode {
        task_frame: pose(at(0)).map_err(|e| format!("force_mode: task_frame: {e}"))?,
        compliant: selection.map(|s| s != 0.0),
        wrench: six(at(2)).map_err(|e| format!("force_mode: wrench: {e}"))?,
        frame_type,
        limits: six(at(4)).map_err(|e| format!("force_mode: limits: {e}"))?,
    })
}

fn three(v: &Value) -> Outcome<[f64; 3]> {
    match v {
        Value::List(items) => match items.as_slice() {
            [x, y, z] => Ok([finite(x)?, finite(y)?, finite(z)?]),
            _ => Err("expected three numbers".to_owned()),
        },
        _ => Err(format!("expected three numbers, got {}", v.type_name())),
    }
}

fn register(name: &str, x: &Value, y: &Value, host: &mut dyn Host) -> Option<Outcome> {
    let bank = if name.starts_with("read_input_") { Bank::Input } else { Bank::Output };
    let read = name.starts_with("read_");
    let write = name.starts_with("write_output_");
    if !(read || write) || name.contains("_port_") {
        return None;
    }
    let access = |host: &mut dyn Host| -> Outcome {
        if name.contains("_integer_") {
            let i = index(x, REGISTERS)?;
            if read {
                return Ok(Value::Int(host.integer_register(bank, i)));
            }
            host.write_integer(i, int32(y)?);
        } else if name.contains("_float_") {
            let i = index(x, REGISTERS)?;
            if read {
                return Ok(Value::Float(host.float_register(bank, i)));
            }
            host.write_float(i, number(y)?);
        } else {
            let i = index(x, BITS)?;
            if read {
                return Ok(Value::Bool(host.bool_register(bank, i)));
            }
            host.write_bool(i, boolean(y)?);
        }
        Ok(Value::None)
    };
    Some(access(host).map_err(|e| format!("{name}: {e}")))
}

fn signal(name: &str, x: &Value, y: &Value, host: &mut dyn Host) -> Option<Outcome> {
    let kind = if name.contains("_tool_") {
        OutputKind::Tool
    } else if name.contains("_configurable_") {
        OutputKind::Configurable
    } else {
        OutputKind::Standard
    };
    let pins = if kind == OutputKind::Tool { 2 } else { 8 };
    let access = |host: &mut dyn Host| -> Outcome {
        Ok(match name {
            _ if name.ends_with("_digital_in") => Value::Bool(host.digital_in(kind, index(x, pins)?)),
            _ if name.ends_with("_analog_in") => Value::Float(host.analog_in(kind, index(x, 2)?)),
            _ if name.starts_with("get_") => Value::Bool(host.digital_out(kind, index(x, pins)?)),
            _ if name.ends_with("_analog_out") => {
                let f = finite(y)?;
                if !(0.0..=1.0).contains(&f) {
                    return Err(format!("{f} is outside 0 to 1"));
                }
                host.set_analog_out(index(x, 2)?, f);
                Value::None
            }
            _ => {
                host.set_digital_out(kind, index(x, pins)?, boolean(y)?);
                Value::None
            }
        })
    };
    let is = ["_digital_in", "_digital_out", "_analog_in", "_analog_out"].iter().any(|e| name.ends_with(e));
    let is = is && !(name.starts_with("get_") && name.ends_with("_analog_out"));
    is.then(|| access(host).map_err(|e| format!("{name}: {e}")))
}
