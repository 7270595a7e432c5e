//! Verbs sent to a running daemon over shared memory.

use super::args::{ClientArgs, SetpointArgs};
use crate::config::Config;
use crate::exit::{Exit, Failure};
use crate::realtime::now_ns;
use graspd_shm::control::{RequestClient, Verb};
use graspd_shm::{Names, create_node};
use std::time::Duration;

/// Where the daemon of these arguments is to be found.
fn names(args: &ClientArgs) -> Result<Names, Failure> {
    match &args.config {
        Some(path) => Ok(Config::load(path)?.names),
        None => crate::config::names(&args.cell, args.shm_root.as_deref()),
    }
}

/// Sends a verb, prints the answer.
///
/// # Errors
/// No daemon, a refused request, or a file that cannot be read.
pub fn send(args: &ClientArgs, verb: Verb, payload: &[u8]) -> Result<Exit, Failure> {
    if !(args.timeout.is_finite() && args.timeout > 0.0 && args.timeout <= 3600.0) {
        return Err(Failure {
            exit: Exit::Usage,
            message: format!("--timeout {} is not a number of seconds from 0 to 3600", args.timeout),
        });
    }
    let node = create_node(&names(args)?, "graspd-client").map_err(|e| Failure::link(e.to_string()))?;
    let client = RequestClient::new(&node).map_err(|e| Failure::link(e.to_string()))?;
    let answer = client
        .ask(verb, payload, now_ns(), Duration::from_secs_f64(args.timeout))
        .map_err(|e| Failure::link(e.to_string()))?;
    if args.json {
        println!("{}", answer.json);
    } else {
        print_words(&answer.json);
    }
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

/// One line a key, nested objects indented.
fn print_words(json: &str) {
    match serde_json::from_str::<serde_json::Value>(json) {
        Ok(serde_json::Value::Object(map)) => {
            for (k, v) in map {
                match v {
                    serde_json::Value::String(s) => println!("{k:>24}  {s}"),
                    serde_json::Value::Object(inner) => {
                        let words: Vec<String> = inner.iter().map(|(a, b)| format!("{a} {b}")).collect();
                        println!("{k:>24}  {}", words.join("  "));
                    }
                    other => println!("{k:>24}  {other}"),
                }
            }
        }
        _ => println!("{json}"),
    }
}
