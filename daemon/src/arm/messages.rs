//! Robot messages of the primary interface: why the controller stopped, what the pendant shows, why a program failed.
//!
//! A robot message (package type 20) is `u64 time, i8 source, u8 kind` and a body that depends on the kind. Unknown
//! kinds are skipped.

use std::io::{self, Read};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use super::primary::header;
use super::status::safety_mode_text;
use super::ur_config::{ArmError, Port, UrConfig};

/// Package type of a robot message.
const ROBOT_MESSAGE: u8 = 20;
/// Maximum length of a message, characters; the rest is cut off.
const MAX_MESSAGE_CHARS: usize = 300;
/// Maximum number of bytes read in one call; the rest is read in the next.
const MAX_POLL_BYTES: usize = 1 << 18;
/// Pause between attempts to connect.
const RETRY_DELAY: Duration = Duration::from_secs(3);
/// Maximum time of an attempt to connect; the caller's thread waits for it.
const CONNECT_TIMEOUT: Duration = Duration::from_millis(300);

/// One robot message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RobotMessage {
    /// Its kind.
    pub kind: MessageKind,
    /// Its text, on one line.
    pub text: String,
}

/// Kinds of message that matter to an operator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MessageKind {
    /// The safety mode changed.
    Safety,
    /// A coded error.
    Error,
    /// A popup on the pendant.
    Popup,
    /// A program failed.
    Program,
}

/// Reads the body of a robot message, without the five bytes of its header; `None` for a kind that does not matter to
/// an operator and for a body that is too short.
pub fn parse_message(body: &[u8]) -> Option<RobotMessage> {
    let (&kind, body) = body.get(9..)?.split_first()?;
    let int = |at: usize| body.get(at..)?.first_chunk::<4>().map(|b| i32::from_be_bytes(*b));
    let message = |kind, text: String| Some(RobotMessage { kind, text: one_line(text) });
    match kind {
        // Request id, request type, three flags, title.
        2 => {
            let length = usize::from(*body.get(8)?);
            let (title, text) = (body.get(9..9 + length)?, body.get(9 + length..)?);
            message(MessageKind::Popup, format!("{}: {}", lossy(title), lossy(text)))
        }
        5 => {
            let (code, argument, mode) = (int(0)?, int(4)?, *body.get(8)?);
            let code = if code == 0 { String::new() } else { format!(" (C{code}A{argument})") };
            message(MessageKind::Safety, format!("{}{code}", safety_mode_text(i32::from(mode))))
        }
        // Code, argument, level, data type, data, text. Levels below 2 are information.
        6 => {
            let (code, argument, level) = (int(0)?, int(4)?, int(8)?);
            if level < 2 {
                return None;
            }
            message(MessageKind::Error, format!("C{code}A{argument} {}", lossy(body.get(20..)?)))
        }
        // Code, argument, title, text.
        7 => {
            let (code, argument, length) = (int(0)?, int(4)?, usize::from(*body.get(8)?));
            let (title, text) = (body.get(9..9 + length)?, body.get(9 + length..)?);
            message(MessageKind::Error, format!("C{code}A{argument} {}: {}", lossy(title), lossy(text)))
        }
        10 => {
            let (line, column) = (int(0)?, int(4)?);
            let place = if line > 0 { format!("line {line}, column {column}: ") } else { String::new() };
            message(MessageKind::Program, format!("{place}{}", lossy(body.get(8..)?)))
        }
        _ => None,
    }
}

fn lossy(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Control characters become spaces, so that a message is one line of the log.
fn one_line(text: String) -> String {
    let clean: String = text.chars().map(|c| if c.is_control() { ' ' } else { c }).take(MAX_MESSAGE_CHARS).collect();
    clean.trim().to_owned()
}

/// Reads robot messages from the primary interface, in parallel to the RTDE session; polled by an ordinary thread.
#[derive(Debug)]
pub struct MessageListener {
    config: UrConfig,
    stream: Option<TcpStream>,
    bytes: Vec<u8>,
    next_try: Instant,
}

impl MessageListener {
    /// A listener without a connection; the first poll connects.
    pub fn new(config: &UrConfig) -> MessageListener {
        let config = UrConfig { timeout: CONNECT_TIMEOUT.min(config.timeout), ..config.clone() };
        MessageListener { config, stream: None, bytes: Vec::new(), next_try: Instant::now() }
    }

    /// The messages that arrived since the last call. Does not wait, except up to 0.3 s for an attempt to connect every
    /// 3 s.
    pub fn poll(&mut self) -> Vec<RobotMessage> {
        let mut messages = Vec::new();
        if self.receive(&mut messages).is_err() {
            (self.stream, self.next_try) = (None, Instant::now() + RETRY_DELAY);
            self.bytes = Vec::new();
        }
        messages
    }

    fn receive(&mut self, messages: &mut Vec<RobotMessage>) -> Result<(), ArmError> {
        let fail = |source| ArmError::Io { service: Port::Primary, source };
        if self.stream.is_none() {
            if Instant::now() < self.next_try {
                return Ok(());
            }
            let stream = self.config.open(Port::Primary)?;
            stream.set_nonblocking(true).map_err(fail)?;
            self.stream = Some(stream);
        }
        let Some(stream) = self.stream.as_mut() else { return Ok(()) };
        let mut chunk = [0u8; 8192];
        let mut got = 0;
        while got < MAX_POLL_BYTES {
            match stream.read(&mut chunk) {
                Ok(0) => return Err(fail(io::ErrorKind::UnexpectedEof.into())),
                Ok(n) => {
                    self.bytes.extend_from_slice(chunk.get(..n).unwrap_or_default());
                    got += n;
                }
                Err(e) if e.kind() == io::ErrorKind::WouldBlock => break,
                Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
                Err(e) => return Err(fail(e)),
            }
            let mut used = 0;
            while let Some(rest) = self.bytes.get(used..).filter(|r| r.len() >= 5) {
                let Some((kind, size)) = header(rest) else {
                    return Err(fail(io::Error::new(io::ErrorKind::InvalidData, "a package of impossible size")));
                };
                let Some(body) = rest.get(5..size) else { break };
                if kind == ROBOT_MESSAGE {
                    messages.extend(parse_message(body));
                }
                used += size;
            }
            self.bytes.drain(..used);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn message(kind: u8, body: &[u8]) -> Vec<u8> {
        [&[0u8; 8][..], &[0xfe, kind], body].concat()
    }

    #[test]
    fn the_cause_of_a_stop_is_reported_with_its_code() {
        let body = [&153i32.to_be_bytes()[..], &2i32.to_be_bytes(), &[3], &[0; 8]].concat();
        let got = parse_message(&message(5, &body)).unwrap();
        assert_eq!(got, RobotMessage { kind: MessageKind::Safety, text: "protective stop (C153A2)".to_owned() });
        let words = [157i32, 1, 3, 0, 0].map(i32::to_be_bytes).concat();
        let got = parse_message(&message(6, &[&words[..], b"joint 1 near\nits limit"].concat())).unwrap();
        assert_eq!(got.text, "C157A1 joint 1 near its limit");
        let popup = [&[0, 0, 0, 0, 0, 1, 0, 0, 5][..], b"TitleText"].concat();
        assert_eq!(parse_message(&message(2, &popup)).unwrap().text, "Title: Text");
        let runtime = [&[0, 0, 0, 7, 0, 0, 0, 3][..], b"name is not defined"].concat();
        assert_eq!(parse_message(&message(10, &runtime)).unwrap().text, "line 7, column 3: name is not defined");
        let info = [157i32, 1, 1, 0, 0].map(i32::to_be_bytes).concat();
        assert_eq!(parse_message(&message(6, &info)), None);
    }

    proptest! {
        #[test]
        fn arbitrary_bytes_do_not_panic(body in proptest::collection::vec(any::<u8>(), 0..120), kind in 0u8..12) {
            parse_message(&body);
            if let Some(got) = parse_message(&message(kind, &body)) {
                prop_assert!(got.text.chars().count() <= MAX_MESSAGE_CHARS && !got.text.contains('\n'));
            }
        }
    }
}
