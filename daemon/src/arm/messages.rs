//! What the controller says on its primary interface: why it stopped, what stands on the pendant, why a program failed.
//!
//! Robot messages (package type 20) are `u64 time, i8 source, u8 kind` and a body by kind. Unknown kinds are passed over.

use std::io::{self, Read};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use super::primary::header;
use super::ur_config::{ArmError, Port, UrConfig};

/// Package type of a robot message.
const ROBOT_MESSAGE: u8 = 20;
/// Characters of a message that are kept.
const LONGEST: usize = 300;
/// Bytes of one call; the rest waits for the next.
const MOST_BYTES: usize = 1 << 18;
/// Pause between attempts to connect.
const RETRY: Duration = Duration::from_secs(3);
/// How long an attempt may take: the caller has other things to do.
const PATIENCE: Duration = Duration::from_millis(300);

/// One message, in words.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Said {
    /// What kind of message it is.
    pub kind: SaidKind,
    /// Its text, on one line.
    pub text: String,
}

/// Kinds of message that an operator has to know of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SaidKind {
    /// The safety mode changed.
    Safety,
    /// A coded error.
    Error,
    /// A popup on the pendant.
    Popup,
    /// A program failed.
    Program,
}

/// Reads the body of a robot message, behind the five bytes of its header; `None` for kinds that matter to no operator, and for
/// bodies that are too short.
pub fn parse_message(body: &[u8]) -> Option<Said> {
    let (&kind, body) = body.get(9..)?.split_first()?;
    let word = |at: usize| body.get(at..)?.first_chunk::<4>().map(|b| i32::from_be_bytes(*b));
    let said = |kind, text: String| Some(Said { kind, text: one_line(text) });
    match kind {
        // Request id, request type, three flags, title.
        2 => {
            let length = usize::from(*body.get(8)?);
            let (title, text) = (body.get(9..9 + length)?, body.get(9 + length..)?);
            said(SaidKind::Popup, format!("{}: {}", lossy(title), lossy(text)))
        }
        5 => {
            let (code, argument, mode) = (word(0)?, word(4)?, *body.get(8)?);
            let code = if code == 0 { String::new() } else { format!(" (C{code}A{argument})") };
            said(SaidKind::Safety, format!("{}{code}", safety_mode(i32::from(mode))))
        }
        // Code, argument, level, data type, data, text. Levels below 2 are information.
        6 => {
            let (code, argument, level) = (word(0)?, word(4)?, word(8)?);
            if level < 2 {
                return None;
            }
            said(SaidKind::Error, format!("C{code}A{argument} {}", lossy(body.get(20..)?)))
        }
        // Code, argument, title, text.
        7 => {
            let (code, argument, length) = (word(0)?, word(4)?, usize::from(*body.get(8)?));
            let (title, text) = (body.get(9..9 + length)?, body.get(9 + length..)?);
            said(SaidKind::Error, format!("C{code}A{argument} {}: {}", lossy(title), lossy(text)))
        }
        10 => {
            let (line, column) = (word(0)?, word(4)?);
            let place = if line > 0 { format!("line {line}, column {column}: ") } else { String::new() };
            said(SaidKind::Program, format!("{place}{}", lossy(body.get(8..)?)))
        }
        _ => None,
    }
}

fn lossy(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Whatever a controller sends, a log line stays a line.
fn one_line(text: String) -> String {
    let clean: String = text.chars().map(|c| if c.is_control() { ' ' } else { c }).take(LONGEST).collect();
    clean.trim().to_owned()
}

/// A safety mode in words.
pub fn safety_mode(mode: i32) -> &'static str {
    match mode {
        1 => "normal",
        2 => "reduced",
        3 => "protective stop",
        4 => "recovery mode: a joint is outside its limits",
        5 | 12 | 18 | 19 => "safeguard stop",
        6 | 15 | 20 => "emergency stop (system input)",
        7 => "emergency stop (button)",
        8 => "safety violation",
        9 => "fault of the safety system",
        10 => "validating joint identity",
        13 | 14 => "three-position enabling switch released",
        _ => "unknown safety mode",
    }
}

/// What `safety_status_bits` say, the gravest first.
pub fn safety_words(bits: u32) -> &'static str {
    let known = [
        (9, "fault of the safety system"),
        (8, "safety violation"),
        (7, "emergency stop"),
        (6, "emergency stop (button)"),
        (5, "emergency stop (system input)"),
        (4, "safeguard stop"),
        (3, "recovery mode"),
        (2, "protective stop"),
        (10, "stopped for safety"),
        (1, "reduced"),
        (0, "normal"),
    ];
    known.into_iter().find(|(bit, _)| bits >> bit & 1 == 1).map_or("unknown", |(_, words)| words)
}

/// A robot mode in words.
pub fn robot_mode(mode: i32) -> &'static str {
    match mode {
        -1 => "no controller",
        0 => "disconnected",
        1 => "waits for the safety configuration to be confirmed",
        2 => "booting",
        3 => "power off",
        4 => "powering on",
        5 => "idle, brakes on",
        6 => "backdrive",
        7 => "running",
        8 => "updating firmware",
        _ => "unknown",
    }
}

/// Listens to the primary interface beside the RTDE session, on an ordinary thread that looks in now and then.
#[derive(Debug)]
pub struct Ear {
    config: UrConfig,
    stream: Option<TcpStream>,
    bytes: Vec<u8>,
    next_try: Instant,
}

impl Ear {
    /// An ear that has not connected yet.
    pub fn new(config: &UrConfig) -> Ear {
        let config = UrConfig { timeout: PATIENCE.min(config.timeout), ..config.clone() };
        Ear { config, stream: None, bytes: Vec::new(), next_try: Instant::now() }
    }

    /// Everything worth knowing that was said since the last call. Returns at once, but for an attempt to connect now and then.
    pub fn listen(&mut self) -> Vec<Said> {
        let mut said = Vec::new();
        if self.take(&mut said).is_err() {
            (self.stream, self.next_try) = (None, Instant::now() + RETRY);
            self.bytes = Vec::new();
        }
        said
    }

    fn take(&mut self, said: &mut Vec<Said>) -> Result<(), ArmError> {
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
        while got < MOST_BYTES {
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
                    said.extend(parse_message(body));
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
    fn what_stopped_the_arm_is_told_with_its_code() {
        let body = [&153i32.to_be_bytes()[..], &2i32.to_be_bytes(), &[3], &[0; 8]].concat();
        let said = parse_message(&message(5, &body)).unwrap();
        assert_eq!(said, Said { kind: SaidKind::Safety, text: "protective stop (C153A2)".to_owned() });
        let words = [157i32, 1, 3, 0, 0].map(i32::to_be_bytes).concat();
        let said = parse_message(&message(6, &[&words[..], b"joint 1 near\nits limit"].concat())).unwrap();
        assert_eq!(said.text, "C157A1 joint 1 near its limit");
        let popup = [&[0, 0, 0, 0, 0, 1, 0, 0, 5][..], b"TitleText"].concat();
        assert_eq!(parse_message(&message(2, &popup)).unwrap().text, "Title: Text");
        let runtime = [&[0, 0, 0, 7, 0, 0, 0, 3][..], b"name is not defined"].concat();
        assert_eq!(parse_message(&message(10, &runtime)).unwrap().text, "line 7, column 3: name is not defined");
        let info = [157i32, 1, 1, 0, 0].map(i32::to_be_bytes).concat();
        assert_eq!(parse_message(&message(6, &info)), None);
    }

    #[test]
    fn the_gravest_safety_bit_is_named() {
        assert_eq!(safety_words(0b1), "normal");
        assert_eq!(safety_words(0b10), "reduced");
        assert_eq!(safety_words(0b100), "protective stop");
        assert_eq!(safety_words(1 << 10 | 1 << 7 | 1 << 6), "emergency stop");
        assert_eq!(safety_words(0), "unknown");
    }

    proptest! {
        #[test]
        fn no_bytes_make_it_panic(body in proptest::collection::vec(any::<u8>(), 0..120), kind in 0u8..12) {
            parse_message(&body);
            if let Some(said) = parse_message(&message(kind, &body)) {
                prop_assert!(said.text.chars().count() <= LONGEST && !said.text.contains('\n'));
            }
        }
    }
}
