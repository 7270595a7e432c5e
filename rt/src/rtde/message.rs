//! The messages of both directions: parsed from a [`Package`], emitted into the caller's buffer.

use core::fmt;

use super::frame::{HEADER, MAX_PACKAGE, Package};

/// Protocol version of a connection; every connection starts in [`Version::V1`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Version {
    /// No recipe id on outputs, no frequency, free-form text messages.
    #[default]
    V1,
    /// Supported by every controller since 3.4 / 5.0.
    V2,
}

impl Version {
    /// The number on the wire.
    pub const fn number(self) -> u16 {
        match self {
            Version::V1 => 1,
            Version::V2 => 2,
        }
    }

    /// The version of this number; `None` if it is not supported.
    pub const fn from_number(number: u16) -> Option<Version> {
        match number {
            1 => Some(Version::V1),
            2 => Some(Version::V2),
            _ => None,
        }
    }
}

/// Type byte of a package.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Kind {
    /// Request protocol version.
    RequestVersion = b'V',
    /// Get the version of URControl.
    ControllerVersion = b'v',
    /// Text message.
    Text = b'M',
    /// Data package.
    Data = b'U',
    /// Set up outputs.
    SetupOutputs = b'O',
    /// Set up inputs.
    SetupInputs = b'I',
    /// Start sending outputs.
    Start = b'S',
    /// Pause sending outputs.
    Pause = b'P',
}

impl Kind {
    /// Every kind.
    pub const ALL: [Kind; 8] = [
        Kind::RequestVersion,
        Kind::ControllerVersion,
        Kind::Text,
        Kind::Data,
        Kind::SetupOutputs,
        Kind::SetupInputs,
        Kind::Start,
        Kind::Pause,
    ];

    /// The kind of a type byte; `None` for an unknown byte.
    pub fn from_byte(byte: u8) -> Option<Kind> {
        Kind::ALL.into_iter().find(|k| *k as u8 == byte)
    }
}

/// Why a package is not a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MessageError {
    /// No message has this type byte.
    UnknownKind(u8),
    /// The body does not have the length of the message.
    Length {
        /// The message.
        kind: Kind,
        /// Length of its body, bytes.
        found: usize,
    },
    /// A list of names or types is not UTF-8.
    NotText(Kind),
    /// A frequency that is not finite.
    NotANumber(Kind),
}

impl fmt::Display for MessageError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            MessageError::UnknownKind(byte) => write!(f, "unknown package type {byte}"),
            MessageError::Length { kind, found } => {
                write!(f, "a package {:?} ('{}') cannot have a body of {found} bytes", kind, *kind as u8 as char)
            }
            MessageError::NotText(kind) => write!(f, "a package {kind:?} has names that are not UTF-8"),
            MessageError::NotANumber(kind) => write!(f, "a package {kind:?} has a number that is not finite"),
        }
    }
}

impl core::error::Error for MessageError {}

/// The message does not fit into the buffer, or is longer than a package can be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NoRoom {
    /// Size of the package, bytes.
    pub needed: usize,
}

impl fmt::Display for NoRoom {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "a package of {} bytes does not fit", self.needed)
    }
}

impl core::error::Error for NoRoom {}

/// Severity of a text message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Level {
    /// 0.
    Exception,
    /// 1.
    Error,
    /// 2.
    Warning,
    /// 3, and anything higher.
    Info,
}

impl Level {
    /// From the byte on the wire.
    pub const fn from_byte(byte: u8) -> Level {
        match byte {
            0 => Level::Exception,
            1 => Level::Error,
            2 => Level::Warning,
            _ => Level::Info,
        }
    }
}

/// A text message. Invalid UTF-8 is replaced when it is displayed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Text<'a> {
    /// Severity.
    pub level: Level,
    /// The text.
    pub message: &'a [u8],
    /// Its source; empty in version 1.
    pub source: &'a [u8],
}

impl<'a> Text<'a> {
    fn parse(version: Version, body: &'a [u8]) -> Option<Text<'a>> {
        if version == Version::V1 {
            let (level, message) = body.split_first()?;
            return Some(Text { level: Level::from_byte(*level), message, source: &[] });
        }
        let (len, rest) = body.split_first()?;
        let (message, rest) = rest.split_at_checked(*len as usize)?;
        let (len, rest) = rest.split_first()?;
        let (source, rest) = rest.split_at_checked(*len as usize)?;
        let [level] = rest else { return None };
        Some(Text { level: Level::from_byte(*level), message, source })
    }

    /// Strings longer than the length byte can state are truncated.
    fn emit(&self, version: Version, out: &mut Writer<'_>) {
        if version == Version::V1 {
            out.put(&[self.level as u8]);
            out.put(self.message);
            return;
        }
        for string in [self.message, self.source] {
            let string = &string[..string.len().min(u8::MAX as usize)];
            out.put(&[string.len() as u8]);
            out.put(string);
        }
        out.put(&[self.level as u8]);
    }
}

impl fmt::Display for Text<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}: ", self.level)?;
        for (lead, bytes) in [("", self.message), (" from ", self.source)] {
            if bytes.is_empty() {
                continue;
            }
            f.write_str(lead)?;
            for chunk in bytes.utf8_chunks() {
                f.write_str(chunk.valid())?;
                if !chunk.invalid().is_empty() {
                    f.write_str("\u{fffd}")?;
                }
            }
        }
        Ok(())
    }
}

/// Version of the controller's software.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ControllerVersion {
    /// 3 for CB3, 5 for e-Series, 10 for PolyScope X.
    pub major: u32,
    /// Minor version.
    pub minor: u32,
    /// Bug-fix version.
    pub bugfix: u32,
    /// Build number.
    pub build: u32,
}

impl ControllerVersion {
    /// Packages per second that this series can send: 125 up to CB3, 500 from the e-Series on.
    pub const fn max_frequency_hz(&self) -> f64 {
        if self.major < 5 { 125.0 } else { 500.0 }
    }
}

impl fmt::Display for ControllerVersion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{}.{}.{}", self.major, self.minor, self.bugfix, self.build)
    }
}

/// A message from a client.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ClientMessage<'a> {
    /// V: request a protocol version by number.
    RequestVersion(u16),
    /// v: request the version of the controller.
    GetControllerVersion,
    /// M: text.
    Text(Text<'a>),
    /// U: values of one input recipe.
    Data {
        /// Id of the recipe.
        recipe: u8,
        /// Its values, packed.
        values: &'a [u8],
    },
    /// O: request outputs.
    SetupOutputs {
        /// Packages per second; `None` in version 1.
        frequency_hz: Option<f64>,
        /// Names separated by commas; see [`names`](super::names).
        names: &'a str,
    },
    /// I: announce inputs.
    SetupInputs {
        /// Names separated by commas.
        names: &'a str,
    },
    /// S: start sending outputs.
    Start,
    /// P: pause sending outputs.
    Pause,
}

/// A message from a controller.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ControllerMessage<'a> {
    /// V: whether the requested version is accepted.
    VersionAccepted(bool),
    /// v: version of the controller.
    ControllerVersion(ControllerVersion),
    /// M: text.
    Text(Text<'a>),
    /// U: values of the output recipe.
    Data {
        /// The recipe's id; `None` in version 1.
        recipe: Option<u8>,
        /// Its values, packed.
        values: &'a [u8],
    },
    /// O: types of the requested outputs.
    OutputsSetUp {
        /// The recipe's id, 0 if refused; `None` in version 1.
        recipe: Option<u8>,
        /// Type names separated by commas; see [`answers`](super::answers).
        types: &'a str,
    },
    /// I: types of the announced inputs.
    InputsSetUp {
        /// The recipe's id, 0 if refused.
        recipe: u8,
        /// Type names separated by commas.
        types: &'a str,
    },
    /// S.
    Started(bool),
    /// P.
    Paused(bool),
}

/// The kind of a package, or an error for an unknown type byte.
fn kind_of(package: &Package<'_>) -> Result<Kind, MessageError> {
    Kind::from_byte(package.kind).ok_or(MessageError::UnknownKind(package.kind))
}

fn text(kind: Kind, bytes: &[u8]) -> Result<&str, MessageError> {
    core::str::from_utf8(bytes).map_err(|_| MessageError::NotText(kind))
}

impl<'a> ClientMessage<'a> {
    /// Parses a client's message on a connection of this version.
    pub fn parse(version: Version, package: Package<'a>) -> Result<ClientMessage<'a>, MessageError> {
        let kind = kind_of(&package)?;
        let body = package.body;
        let length = MessageError::Length { kind, found: body.len() };
        let empty = |message| if body.is_empty() { Ok(message) } else { Err(length) };
        match kind {
            Kind::RequestVersion => match body {
                &[high, low] => Ok(ClientMessage::RequestVersion(u16::from_be_bytes([high, low]))),
                _ => Err(length),
            },
            Kind::ControllerVersion => empty(ClientMessage::GetControllerVersion),
            Kind::Text => Text::parse(version, body).map(ClientMessage::Text).ok_or(length),
            Kind::Data => {
                let (recipe, values) = body.split_first().ok_or(length)?;
                Ok(ClientMessage::Data { recipe: *recipe, values })
            }
            Kind::SetupOutputs if version == Version::V1 => {
                Ok(ClientMessage::SetupOutputs { frequency_hz: None, names: text(kind, body)? })
            }
            Kind::SetupOutputs => {
                let (frequency, names) = body.split_first_chunk::<8>().ok_or(length)?;
                let frequency = f64::from_be_bytes(*frequency);
                if !frequency.is_finite() {
                    return Err(MessageError::NotANumber(kind));
                }
                Ok(ClientMessage::SetupOutputs { frequency_hz: Some(frequency), names: text(kind, names)? })
            }
            Kind::SetupInputs => Ok(ClientMessage::SetupInputs { names: text(kind, body)? }),
            Kind::Start => empty(ClientMessage::Start),
            Kind::Pause => empty(ClientMessage::Pause),
        }
    }

    /// Writes the complete package to `out` and returns its length.
    ///
    /// In version 1 the frequency is left out. In version 2 a missing frequency is sent as 0, which means the
    /// controller's maximum.
    pub fn emit(&self, version: Version, out: &mut [u8]) -> Result<usize, NoRoom> {
        match *self {
            ClientMessage::RequestVersion(number) => {
                package(Kind::RequestVersion, out, |w| w.put(&number.to_be_bytes()))
            }
            ClientMessage::GetControllerVersion => package(Kind::ControllerVersion, out, |_| {}),
            ClientMessage::Text(text) => package(Kind::Text, out, |w| text.emit(version, w)),
            ClientMessage::Data { recipe, values } => package(Kind::Data, out, |w| {
                w.put(&[recipe]);
                w.put(values);
            }),
            ClientMessage::SetupOutputs { frequency_hz, names } => package(Kind::SetupOutputs, out, |w| {
                if version == Version::V2 {
                    w.put(&frequency_hz.unwrap_or(0.0).to_be_bytes());
                }
                w.put(names.as_bytes());
            }),
            ClientMessage::SetupInputs { names } => package(Kind::SetupInputs, out, |w| w.put(names.as_bytes())),
            ClientMessage::Start => package(Kind::Start, out, |_| {}),
            ClientMessage::Pause => package(Kind::Pause, out, |_| {}),
        }
    }
}

impl<'a> ControllerMessage<'a> {
    /// Parses a controller's message on a connection of this version.
    pub fn parse(version: Version, package: Package<'a>) -> Result<ControllerMessage<'a>, MessageError> {
        let kind = kind_of(&package)?;
        let body = package.body;
        let length = MessageError::Length { kind, found: body.len() };
        let flag = || if let [byte] = body { Ok(*byte != 0) } else { Err(length) };
        match kind {
            Kind::RequestVersion => flag().map(ControllerMessage::VersionAccepted),
            Kind::Start => flag().map(ControllerMessage::Started),
            Kind::Pause => flag().map(ControllerMessage::Paused),
            Kind::ControllerVersion => {
                let (words, rest) = body.as_chunks::<4>();
                let ([major, minor, bugfix, build], []) = (words, rest) else { return Err(length) };
                Ok(ControllerMessage::ControllerVersion(ControllerVersion {
                    major: u32::from_be_bytes(*major),
                    minor: u32::from_be_bytes(*minor),
                    bugfix: u32::from_be_bytes(*bugfix),
                    build: u32::from_be_bytes(*build),
                }))
            }
            Kind::Text => Text::parse(version, body).map(ControllerMessage::Text).ok_or(length),
            Kind::Data if version == Version::V1 => Ok(ControllerMessage::Data { recipe: None, values: body }),
            Kind::Data => {
                let (recipe, values) = body.split_first().ok_or(length)?;
                Ok(ControllerMessage::Data { recipe: Some(*recipe), values })
            }
            Kind::SetupOutputs if version == Version::V1 => {
                Ok(ControllerMessage::OutputsSetUp { recipe: None, types: text(kind, body)? })
            }
            Kind::SetupOutputs => {
                let (recipe, types) = body.split_first().ok_or(length)?;
                Ok(ControllerMessage::OutputsSetUp { recipe: Some(*recipe), types: text(kind, types)? })
            }
            Kind::SetupInputs => {
                let (recipe, types) = body.split_first().ok_or(length)?;
                Ok(ControllerMessage::InputsSetUp { recipe: *recipe, types: text(kind, types)? })
            }
        }
    }

    /// Writes the complete package to `out` and returns its length. Version 1 has no recipe ids of outputs, so they are
    /// left out; in version 2 a missing id is sent as 0.
    pub fn emit(&self, version: Version, out: &mut [u8]) -> Result<usize, NoRoom> {
        let id = |w: &mut Writer<'_>, recipe: Option<u8>| {
            if version == Version::V2 {
                w.put(&[recipe.unwrap_or(0)]);
            }
        };
        match *self {
            ControllerMessage::VersionAccepted(yes) => package(Kind::RequestVersion, out, |w| w.put(&[yes as u8])),
            ControllerMessage::Started(yes) => package(Kind::Start, out, |w| w.put(&[yes as u8])),
            ControllerMessage::Paused(yes) => package(Kind::Pause, out, |w| w.put(&[yes as u8])),
            ControllerMessage::ControllerVersion(v) => package(Kind::ControllerVersion, out, |w| {
                for word in [v.major, v.minor, v.bugfix, v.build] {
                    w.put(&word.to_be_bytes());
                }
            }),
            ControllerMessage::Text(text) => package(Kind::Text, out, |w| text.emit(version, w)),
            ControllerMessage::Data { recipe, values } => package(Kind::Data, out, |w| {
                id(w, recipe);
                w.put(values);
            }),
            ControllerMessage::OutputsSetUp { recipe, types } => package(Kind::SetupOutputs, out, |w| {
                id(w, recipe);
                w.put(types.as_bytes());
            }),
            ControllerMessage::InputsSetUp { recipe, types } => package(Kind::SetupInputs, out, |w| {
                w.put(&[recipe]);
                w.put(types.as_bytes());
            }),
        }
    }
}

/// Writes while there is room, and only counts the bytes after that.
pub(super) struct Writer<'a> {
    out: &'a mut [u8],
    len: usize,
}

impl Writer<'_> {
    pub(super) fn put(&mut self, bytes: &[u8]) {
        let end = self.len + bytes.len();
        if let Some(room) = self.out.get_mut(self.len..end) {
            room.copy_from_slice(bytes);
        }
        self.len = end;
    }
}

/// Writes a package: the body by `body`, then its header.
pub(super) fn package(kind: Kind, out: &mut [u8], body: impl FnOnce(&mut Writer<'_>)) -> Result<usize, NoRoom> {
    let mut writer = Writer { out, len: 0 };
    writer.put(&[0, 0, kind as u8]);
    debug_assert_eq!(writer.len, HEADER);
    body(&mut writer);
    let needed = writer.len;
    if needed > MAX_PACKAGE || needed > out.len() {
        return Err(NoRoom { needed });
    }
    let size = out.first_chunk_mut::<2>().ok_or(NoRoom { needed })?;
    *size = (needed as u16).to_be_bytes();
    Ok(needed)
}
