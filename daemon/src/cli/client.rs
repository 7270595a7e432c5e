//! The subcommands that send a request to a running daemon.

use super::args::SetpointArgs;
use super::client_args::ClientArgs;
use crate::config::Config;
use crate::exit::{Exit, Failure};
use crate::realtime::now_ns;
use crate::stop::{StopAnswer, ask as request_stop};
use graspd_shm::control::{Answer, RequestClient, Verb};
use graspd_shm::{Names, create_node};
use serde_json::Value;
use std::time::{Duration, Instant};

/// Shared-memory names of the daemon that the arguments select.
fn names(args: &ClientArgs) -> Result<Names, Failure> {
    match &args.config {
        Some(path) => Ok(Config::load(path)?.names),
        None => crate::config::names(&args.cell, args.shm_root.as_deref()),
    }
}

/// Connects to the daemon.
fn connect(args: &ClientArgs) -> Result<RequestClient, Failure> {
    connect_to(&names(args)?, args)
}

fn connect_to(names: &Names, args: &ClientArgs) -> Result<RequestClient, Failure> {
    if !(args.timeout.is_finite() && args.timeout > 0.0 && args.timeout <= 3600.0) {
        return Err(Failure {
            exit: Exit::Usage,
            message: format!("--timeout {}: give a number of seconds above 0, at most 3600", args.timeout),
        });
    }
    let node = create_node(names, "graspd-client").map_err(|e| Failure::link(e.to_string()))?;
    RequestClient::new(&node).map_err(|e| Failure::link(e.to_string()))
}

fn ask(client: &RequestClient, args: &ClientArgs, verb: Verb, payload: &[u8]) -> Result<Answer, Failure> {
    client.ask(verb, payload, now_ns(), Duration::from_secs_f64(args.timeout)).map_err(|e| Failure::link(e.to_string()))
}

/// Sends a verb and prints the answer.
///
/// # Errors
/// No daemon, a refused request, or a file that cannot be read.
pub fn send(args: &ClientArgs, verb: Verb, payload: &[u8]) -> Result<Exit, Failure> {
    let answer = ask(&connect(args)?, args, verb, payload)?;
    show(args, &answer);
    exit_of(&answer)
}

fn show(args: &ClientArgs, answer: &Answer) {
    if args.json {
        println!("{}", answer.json);
    } else {
        print_table(&answer.json);
    }
}

/// `graspd stop`: by the stop socket, else by a signal; over shared memory only where both fail. It reads only the cell
/// and the shared-memory root from the configuration: an invalid file must not prevent a stop.
///
/// # Errors
/// No daemon was found, or its command thread does not take the stop.
pub fn stop(args: &ClientArgs) -> Result<Exit, Failure> {
    let names = match &args.config {
        Some(path) => crate::config::names_of(path)?,
        None => crate::config::names(&args.cell, args.shm_root.as_deref())?,
    };
    let (by, state) = match request_stop(&names) {
        StopAnswer::Socket { taken: true, mode } => ("socket", mode),
        StopAnswer::Socket { taken: false, mode } => {
            return Err(Failure::fault(format!(
                "the daemon received the stop, but its command thread does not respond (last mode {mode}); the controller's watchdog \
                 stops the arm; use the emergency stop if it moves"
            )));
        }
        StopAnswer::Signal { .. } => ("signal", "signalled".to_owned()),
        StopAnswer::NoDaemon(why) => {
            return by_verb(&names, args).map_err(|e| Failure { message: format!("{e}\n{why}"), ..e });
        }
    };
    let answer = serde_json::json!({ "accepted": true, "by": by, "state": state });
    show(args, &Answer { accepted: true, json: answer.to_string() });
    Ok(Exit::Done)
}

/// A stop over shared memory.
fn by_verb(names: &Names, args: &ClientArgs) -> Result<Exit, Failure> {
    let answer = ask(&connect_to(names, args)?, args, Verb::Stop, b"")?;
    show(args, &answer);
    exit_of(&answer)
}

/// Timeout of a recovery: power, brakes, unlocking and a new session.
const RECOVERY_TIMEOUT: Duration = Duration::from_secs(90);

/// `graspd recover`: requests a recovery, prints each step, and returns when the arm is idle in a new session.
///
/// # Errors
/// As [`send`], and the step that the controller refuses.
pub fn recover(args: &ClientArgs) -> Result<Exit, Failure> {
    let client = connect(args)?;
    let status = || -> Result<(Answer, Value), Failure> {
        let answer = ask(&client, args, Verb::Status, b"")?;
        let value = serde_json::from_str(&answer.json).unwrap_or(Value::Null);
        Ok((answer, value))
    };
    let number = |v: &Value| v.pointer("/recovery/number").and_then(Value::as_u64).unwrap_or(0);
    let before = number(&status()?.1);
    let answer = ask(&client, args, Verb::Recover, b"")?;
    if !answer.accepted {
        show(args, &answer);
        return exit_of(&answer);
    }
    let (start, mut printed) = (Instant::now(), 0);
    loop {
        std::thread::sleep(Duration::from_millis(100));
        let (answer, v) = status()?;
        let steps = v.pointer("/recovery/steps").and_then(Value::as_array).cloned().unwrap_or_default();
        let started = number(&v) > before;
        let running = v.pointer("/recovery/running").and_then(Value::as_bool).unwrap_or(false);
        if started && !args.json {
            steps.iter().skip(printed).filter_map(Value::as_str).for_each(|s| println!("{s}"));
            printed = steps.len();
        }
        let robot = v.get("robot").and_then(Value::as_str).unwrap_or_default();
        let error = v.pointer("/recovery/error").and_then(Value::as_str).map(str::to_owned);
        // The first connection may come too early for the controller: only an error that persists is reported.
        let persists = start.elapsed() > Duration::from_secs(15);
        let error = error.or_else(|| robot.strip_prefix("down: ").filter(|_| persists).map(str::to_owned));
        let ended = started && !running && (error.is_some() || robot == "up");
        if ended || start.elapsed() > RECOVERY_TIMEOUT {
            if args.json {
                println!("{}", answer.json);
            }
            return match error {
                Some(e) => Err(Failure::link(format!("not recovered: {e}"))),
                None if !ended => Err(Failure::link(format!(
                    "not recovered within {} s; the robot link is: {robot}",
                    RECOVERY_TIMEOUT.as_secs()
                ))),
                None => {
                    if !args.json {
                        let fault = v.get("state").and_then(Value::as_str) == Some("fault");
                        let next = if fault { "; `graspd reset` clears the fault" } else { "" };
                        println!("the robot is running and the arm is idle{next}");
                    }
                    Ok(Exit::Done)
                }
            };
        }
    }
}

/// The exit code of an answer.
fn exit_of(answer: &Answer) -> Result<Exit, Failure> {
    if answer.accepted {
        return Ok(Exit::Done);
    }
    let reason = serde_json::from_str::<serde_json::Value>(&answer.json).ok();
    let fault = reason.as_ref().and_then(|v| v.get("state")).and_then(|v| v.as_str()) == Some("fault");
    let text = reason
        .and_then(|v| v.get("reason").and_then(|r| r.as_str()).map(str::to_owned))
        .unwrap_or_else(|| "refused".into());
    Err(Failure { exit: if fault { Exit::Fault } else { Exit::NotConverged }, message: text })
}

/// `graspd setpoint FILE`.
///
/// # Errors
/// As [`send`], and when the file cannot be read.
pub fn setpoint(args: &SetpointArgs) -> Result<Exit, Failure> {
    let text = std::fs::read(&args.plan).map_err(|e| {
        Failure::input(format!(
            "{}: cannot be read ({e}); make a plan with 'graspd plan ... --out {}'",
            args.plan.display(),
            args.plan.display()
        ))
    })?;
    send(&args.client, Verb::Setpoint, &text)
}

/// Prints one line for each key, with nested objects on the same line.
fn print_table(json: &str) {
    match serde_json::from_str::<serde_json::Value>(json) {
        Ok(serde_json::Value::Object(map)) => {
            for (k, v) in map {
                match v {
                    serde_json::Value::String(s) => println!("{k:>24}  {s}"),
                    serde_json::Value::Object(inner) => {
                        let pairs: Vec<String> = inner.iter().map(|(a, b)| format!("{a} {b}")).collect();
                        println!("{k:>24}  {}", pairs.join("  "));
                    }
                    other => println!("{k:>24}  {other}"),
                }
            }
        }
        _ => println!("{json}"),
    }
}
