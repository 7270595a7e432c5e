//! Sockets of a script: receive buffers, and conversion between bytes and numbers, lines and strings.

use super::arithmetic::{MAX_TEXT_BYTES, Outcome};
use super::host::{Connect, Host, Received};
use super::pure::{boolean, index, int32, number, text};
use super::value::Value;
use super::wait::{Flow, Read, SocketWait, Wait};
use std::collections::BTreeMap;

/// Sockets of a script.
const MAX_SOCKETS: usize = 16;
/// Bytes buffered for a script that does not read; beyond them the socket is closed.
const MAX_BUFFER: usize = 1 << 16;
/// Numbers per read, exclusive; UR's limit is 30.
const MAX_NUMBERS: usize = 256;
/// Longest prefix or suffix of `socket_read_string`, bytes.
const MAX_DELIMITER: usize = 256;
/// Time after which an attempt to connect fails, s.
const CONNECT_TIMEOUT_S: f64 = 2.0;

/// Received bytes that the script has not read, by socket.
#[derive(Default)]
pub(crate) struct SocketBuffers(BTreeMap<String, Vec<u8>>);

/// Control steps in `seconds`, at least one. `None` (no timeout) for zero and less, like UR's timeout of 0.
fn steps(seconds: f64, host: &dyn Host) -> Option<u32> {
    (seconds > 0.0).then(|| (seconds / host.step_time()).ceil().clamp(1.0, 1e9) as u32)
}

/// Calls a socket built-in; `None` if `function` is not one.
pub(crate) fn call(function: &str, a: &[Value], host: &mut dyn Host, s: &mut SocketBuffers) -> Option<Outcome<Flow>> {
    function.starts_with("socket_").then(|| dispatch(function, a, host, s))
}

fn dispatch(function: &str, a: &[Value], host: &mut dyn Host, s: &mut SocketBuffers) -> Outcome<Flow> {
    let none = Value::None;
    let [x, y, z] = [0, 1, 2].map(|i| a.get(i).unwrap_or(&none));
    match function {
        "socket_open" => {
            let name = text(z)?.to_owned();
            s.close(&name, host);
            if s.0.len() >= MAX_SOCKETS {
                return Err(format!("more than {MAX_SOCKETS} sockets"));
            }
            s.0.insert(name.clone(), Vec::new());
            let port = u16::try_from(index(y, 65_536)?).unwrap_or(0);
            let steps = steps(CONNECT_TIMEOUT_S, host).unwrap_or(1);
            resume(SocketWait::Connect { name, address: text(x)?.to_owned(), port, steps }, host, s)
        }
        "socket_close" => {
            s.close(text(x)?, host);
            Ok(Flow::Value(Value::Bool(true)))
        }
        "socket_send_int" => Ok(send(&int32(x)?.to_be_bytes(), text(y)?, host, s)),
        "socket_send_byte" => match x {
            Value::Str(one) => Ok(send(&one.as_bytes()[..one.len().min(1)], text(y)?, host, s)),
            n => Ok(send(&[u8::try_from(index(n, 256)?).unwrap_or(0)], text(y)?, host, s)),
        },
        "socket_send_string" => Ok(send(x.to_string().as_bytes(), text(y)?, host, s)),
        "socket_send_line" => Ok(send(format!("{x}\n").as_bytes(), text(y)?, host, s)),
        "socket_read_binary_integer" => read(Read::Integers(index(x, MAX_NUMBERS)?), y, z, host, s),
        "socket_read_byte_list" => read(Read::Bytes(index(x, MAX_NUMBERS)?), y, z, host, s),
        "socket_read_ascii_float" => read(Read::Floats(index(x, MAX_NUMBERS)?), y, z, host, s),
        "socket_read_line" => read(Read::Line, x, y, host, s),
        "socket_read_string" => {
            let escapes = boolean(a.get(3).unwrap_or(&none))?;
            let what = Read::Any { prefix: delimiter(y, escapes)?, suffix: delimiter(z, escapes)? };
            read(what, x, a.get(4).unwrap_or(&none), host, s)
        }
        "socket_get_var" => {
            let (name, socket) = (text(x)?.to_owned(), text(y)?);
            if !(s.0.contains_key(socket) && host.socket_send(socket, format!("GET {name}\n").as_bytes())) {
                return Ok(Flow::Value(Value::Int(0)));
            }
            read(Read::Variable(name), y, z, host, s)
        }
        "socket_set_var" => Ok(send(format!("SET {} {}\n", text(x)?, int32(y)?).as_bytes(), text(z)?, host, s)),
        _ => Err(format!("function '{function}' is not known to this controller")),
    }
}

/// A prefix or suffix; escape sequences are interpreted on request.
fn delimiter(v: &Value, escapes: bool) -> Outcome<String> {
    let plain = text(v)?;
    if plain.len() > MAX_DELIMITER {
        return Err(format!("a prefix or suffix of more than {MAX_DELIMITER} bytes"));
    }
    Ok(if escapes { plain.replace("\\n", "\n").replace("\\r", "\r").replace("\\t", "\t") } else { plain.to_owned() })
}

/// Position of `delimiter` in `bytes`.
fn position(bytes: &[u8], delimiter: &str) -> Option<usize> {
    if delimiter.is_empty() { Some(0) } else { bytes.windows(delimiter.len()).position(|w| w == delimiter.as_bytes()) }
}

fn send(bytes: &[u8], name: &str, host: &mut dyn Host, s: &SocketBuffers) -> Flow {
    Flow::Value(Value::Bool(s.0.contains_key(name) && host.socket_send(name, bytes)))
}

fn read(what: Read, name: &Value, timeout: &Value, host: &mut dyn Host, s: &mut SocketBuffers) -> Outcome<Flow> {
    let steps = steps(number(timeout)?, host);
    let name = text(name)?.to_owned();
    s.fill(&name, host);
    match s.take(&name, &what) {
        Some(value) => Ok(Flow::Value(value)),
        None => Ok(Flow::Wait(Wait::Socket(SocketWait::Read { name, what, steps }))),
    }
}

/// Continues a blocking call, once in each control step.
pub(crate) fn resume(wait: SocketWait, host: &mut dyn Host, s: &mut SocketBuffers) -> Outcome<Flow> {
    match wait {
        SocketWait::Connect { name, address, port, steps } => match host.socket_connect(&name, &address, port) {
            Connect::Open => Ok(Flow::Value(Value::Bool(true))),
            Connect::Pending if steps > 1 => {
                Ok(Flow::Wait(Wait::Socket(SocketWait::Connect { name, address, port, steps: steps - 1 })))
            }
            Connect::Pending | Connect::Failed => {
                s.close(&name, host);
                Ok(Flow::Value(Value::Bool(false)))
            }
        },
        SocketWait::Read { name, what, steps } => {
            let open = s.fill(&name, host);
            if let Some(value) = s.take(&name, &what) {
                return Ok(Flow::Value(value));
            }
            if !open || steps == Some(1) {
                return Ok(Flow::Value(nothing(&what)));
            }
            Ok(Flow::Wait(Wait::Socket(SocketWait::Read { name, what, steps: steps.map(|n| n - 1) })))
        }
    }
}

/// Result of a read after its timeout: a count of zero and filler values, or an empty string.
fn nothing(what: &Read) -> Value {
    let list = |n: usize, filler: Value| {
        let mut out = vec![Value::Int(0)];
        out.resize(n + 1, filler);
        Value::List(out)
    };
    match what {
        Read::Integers(n) | Read::Bytes(n) => list(*n, Value::Int(-1)),
        Read::Floats(n) => list(*n, Value::Float(f64::NAN)),
        Read::Line | Read::Any { .. } => Value::Str(String::new()),
        Read::Variable(_) => Value::Int(0),
    }
}

fn counted(items: Vec<Value>) -> Value {
    let mut out = vec![Value::Int(i32::try_from(items.len()).unwrap_or(i32::MAX))];
    out.extend(items);
    Value::List(out)
}

impl SocketBuffers {
    fn close(&mut self, name: &str, host: &mut dyn Host) {
        if self.0.remove(name).is_some() {
            host.socket_close(name);
        }
    }

    pub(crate) fn close_all(&mut self, host: &mut dyn Host) {
        for name in std::mem::take(&mut self.0).into_keys() {
            host.socket_close(&name);
        }
    }

    /// Buffers received bytes; false if the connection is closed.
    fn fill(&mut self, name: &str, host: &mut dyn Host) -> bool {
        let Some(buffer) = self.0.get_mut(name) else { return false };
        match host.socket_receive(name) {
            Received::Bytes(bytes) if buffer.len() + bytes.len() <= MAX_BUFFER => {
                buffer.extend(bytes);
                true
            }
            Received::Nothing => true,
            Received::Bytes(_) => {
                self.close(name, host);
                false
            }
            Received::Closed => false,
        }
    }

    fn take(&mut self, name: &str, what: &Read) -> Option<Value> {
        let buffer = self.0.get_mut(name)?;
        let line_end = |b: &[u8]| b.iter().position(|c| *c == b'\n');
        match what {
            Read::Integers(n) => {
                if buffer.len() < n * 4 {
                    return None;
                }
                let bytes: Vec<u8> = buffer.drain(..n * 4).collect();
                let number = |c: &[u8]| Value::Int(c.iter().fold(0_u32, |v, b| v << 8 | u32::from(*b)).cast_signed());
                Some(counted(bytes.chunks_exact(4).map(number).collect()))
            }
            Read::Bytes(n) => {
                if buffer.len() < *n {
                    return None;
                }
                Some(counted(buffer.drain(..*n).map(|b| Value::Int(i32::from(b))).collect()))
            }
            Read::Floats(n) => {
                // `(1.0, 2.0)` up to the closing bracket.
                let end = buffer.iter().position(|c| *c == b')')?;
                let line: Vec<u8> = buffer.drain(..=end).collect();
                let text = String::from_utf8_lossy(&line);
                let numbers: Vec<Value> = text
                    .trim_matches(|c: char| c == '(' || c == ')' || c.is_whitespace())
                    .split(',')
                    .filter_map(|t| t.trim().parse().ok().map(Value::Float))
                    .collect();
                Some(if numbers.len() == *n { counted(numbers) } else { nothing(what) })
            }
            Read::Line => {
                let end = line_end(buffer)?;
                let line: Vec<u8> = buffer.drain(..=end).collect();
                let text = String::from_utf8_lossy(&line);
                Some(Value::Str(text.trim_end_matches(['\r', '\n']).chars().take(MAX_TEXT_BYTES / 4).collect()))
            }
            Read::Any { prefix, suffix } => {
                let from = position(buffer, prefix)? + prefix.len();
                let rest = buffer.get(from..).unwrap_or_default();
                let n = if suffix.is_empty() { rest.len() } else { position(rest, suffix)? };
                if suffix.is_empty() && n == 0 {
                    return None;
                }
                let n = n.min(MAX_TEXT_BYTES / 4);
                let found = String::from_utf8_lossy(rest.get(..n).unwrap_or_default()).into_owned();
                buffer.drain(..(from + n + suffix.len()).min(buffer.len()));
                Some(Value::Str(found))
            }
            Read::Variable(name) => {
                let end = line_end(buffer)?;
                let line: Vec<u8> = buffer.drain(..=end).collect();
                let line = String::from_utf8_lossy(&line);
                let number = line.trim().strip_prefix(name.as_str()).and_then(|n| n.trim().parse().ok());
                Some(Value::Int(number.unwrap_or(0)))
            }
        }
    }
}
