//! The client's half of a session: which message to send next, and what an answer means. No socket, no clock.
//!
//! The order of messages: V, v, O, one I for each input recipe, S; then data in both directions.

use core::fmt;

use super::fields::{Field, Side};
use super::frame::Package;
use super::message::{ClientMessage, ControllerMessage, ControllerVersion, Kind, MessageError, NoRoom, Text, Version};
use super::recipe::{Answer, Entry, Recipe, RecipeError, answers, join};
use super::value::FieldType;

/// Most input recipes of one session.
pub const MAX_INPUT_RECIPES: usize = 8;

/// Most fields of one recipe.
pub const MAX_FIELDS: usize = 64;

/// Longest name list that every controller accepts (RTDE manual), bytes.
pub const MAX_NAME_LIST: usize = 2048;

/// A recipe of at most [`MAX_FIELDS`] fields.
pub type SessionRecipe = Recipe<MAX_FIELDS>;

/// Why a session cannot continue.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ClientError {
    /// A package is malformed.
    Message(MessageError),
    /// A message does not fit the buffer.
    NoRoom(NoRoom),
    /// The controller refuses protocol versions 2 and 1.
    VersionRefused,
    /// The controller does not have this variable: its software is too old, or it is of another series.
    NotFound(Field),
    /// Another client holds this input.
    InUse(Field),
    /// The variable has a type other than that of the protocol.
    WrongType {
        /// The variable.
        field: Field,
        /// Type that the controller states.
        found: FieldType,
    },
    /// The type list does not have one known type for each name.
    WrongList(Side),
    /// Inputs were accepted without a recipe id.
    NoRecipeId,
    /// An answer without a request.
    Unexpected(Kind),
    /// The controller refuses to start.
    StartRefused,
    /// A data package of an unknown recipe.
    WrongRecipe(u8),
    /// A data package does not have the length of its recipe.
    DataLength {
        /// Size of the recipe's values, bytes.
        expected: usize,
        /// Size of the received values, bytes.
        found: usize,
    },
    /// A requested recipe is not possible.
    Recipe(RecipeError),
    /// The names of a recipe are longer than [`MAX_NAME_LIST`].
    NameList,
}

impl fmt::Display for ClientError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ClientError::Message(e) => e.fmt(f),
            ClientError::NoRoom(e) => e.fmt(f),
            ClientError::VersionRefused => f.write_str("the controller refuses RTDE protocol versions 2 and 1"),
            ClientError::NotFound(field) => {
                write!(
                    f,
                    "the controller has no variable `{field}` (NOT_FOUND): its software is older than graspd needs, update it"
                )
            }
            ClientError::InUse(field) => write!(
                f,
                "`{field}` is held by another RTDE client (IN_USE), likely {}: end that client; after a crash the variable is free \
                 as soon as its connection ends",
                likely_owner(*field)
            ),
            ClientError::WrongType { field, found } => {
                write!(f, "`{field}` has type {found} on this controller, expected {}", field.kind())
            }
            ClientError::WrongList(side) => {
                write!(f, "the answer to the {side:?} recipe does not have one type for each name")
            }
            ClientError::NoRecipeId => f.write_str("the answer to the input recipe has no recipe id"),
            ClientError::Unexpected(kind) => write!(f, "answer {kind:?} without a request"),
            ClientError::StartRefused => f.write_str("the controller refuses to start sending data"),
            ClientError::WrongRecipe(id) => write!(f, "data package of recipe {id}, which is not set up"),
            ClientError::DataLength { expected, found } => {
                write!(f, "data package has {found} bytes of values, its recipe has {expected}")
            }
            ClientError::Recipe(e) => e.fmt(f),
            ClientError::NameList => write!(f, "the names of a recipe are longer than {MAX_NAME_LIST} bytes"),
        }
    }
}

/// Who usually holds an input that is in use.
fn likely_owner(field: Field) -> &'static str {
    match field.stem() {
        // A fieldbus takes integer and float registers below 24 and bits below 64 as soon as it is enabled.
        ("input_int_register_" | "input_double_register_", Some(0..24)) | ("input_bit_register_", Some(0..64)) => {
            "an EtherNet/IP or PROFINET adapter (disable it in the installation), or a program that uses the lower registers"
        }
        ("input_int_register_" | "input_double_register_" | "input_bit_register_", _) => {
            "another graspd, a ROS driver, an ur_rtde program with the upper range, or a URCap"
        }
        ("external_force_torque", _) => "a force sensor's URCap or an ur_rtde program",
        _ => "a ROS driver, an ur_rtde program, a URCap, or an EtherNet/IP or PROFINET adapter",
    }
}

impl core::error::Error for ClientError {}

impl From<MessageError> for ClientError {
    fn from(e: MessageError) -> Self {
        ClientError::Message(e)
    }
}

impl From<RecipeError> for ClientError {
    fn from(e: RecipeError) -> Self {
        ClientError::Recipe(e)
    }
}

/// Meaning of a package for the session.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Event<'a> {
    /// A step of the handshake is done; [`Session::transmit`] has the next message.
    Progress,
    /// Values of the output recipe, with exactly its size.
    Data(&'a [u8]),
    /// A text message of the controller.
    Text(Text<'a>),
    /// The controller stopped sending, as requested.
    Paused,
}

/// State of the handshake.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Phase {
    /// Protocol version requested.
    Version(Version),
    /// Controller version requested.
    Identity,
    /// Outputs requested.
    Outputs,
    /// Inputs of this recipe announced.
    Inputs(usize),
    /// Start requested.
    Starting,
    /// Data is exchanged.
    Running,
    /// Paused.
    Paused,
}

/// A client session.
///
/// Pass complete packages to [`handle`](Session::handle) and send what [`transmit`](Session::transmit) writes, until
/// [`phase`](Session::phase) is [`Phase::Running`]. Nothing is sent twice: `transmit` returns `None` while it awaits an
/// answer.
#[derive(Clone, Debug)]
pub struct Session {
    outputs: SessionRecipe,
    inputs: heapless::Vec<(u8, SessionRecipe), MAX_INPUT_RECIPES>,
    frequency_hz: Option<f64>,
    version: Version,
    controller: Option<ControllerVersion>,
    output_id: Option<u8>,
    phase: Phase,
    awaiting: bool,
}

impl Session {
    /// A session for these variables. `frequency_hz` is the controller's maximum if `None`, and at most that.
    ///
    /// # Errors
    /// Unknown names, or too many of them.
    pub fn new(outputs: &[&str], inputs: &[&[&str]], frequency_hz: Option<f64>) -> Result<Session, ClientError> {
        let mut session = Session {
            outputs: Recipe::resolve(Side::Output, outputs)?,
            inputs: heapless::Vec::new(),
            frequency_hz,
            version: Version::V1,
            controller: None,
            output_id: None,
            phase: Phase::Version(Version::V2),
            awaiting: false,
        };
        for names in inputs {
            let recipe = Recipe::resolve(Side::Input, names)?;
            let too_many = ClientError::Recipe(RecipeError::TooMany { capacity: MAX_INPUT_RECIPES });
            session.inputs.push((0, recipe)).map_err(|_| too_many)?;
        }
        Ok(session)
    }

    /// State of the handshake.
    pub fn phase(&self) -> Phase {
        self.phase
    }

    /// Whether the session awaits an answer; [`transmit`](Session::transmit) then returns `None`.
    pub fn is_awaiting(&self) -> bool {
        self.awaiting
    }

    /// Protocol version of the connection.
    pub fn version(&self) -> Version {
        self.version
    }

    /// Software version of the controller, once known.
    pub fn controller(&self) -> Option<ControllerVersion> {
        self.controller
    }

    /// The output recipe.
    pub fn outputs(&self) -> &SessionRecipe {
        &self.outputs
    }

    /// Id and fields of an input recipe; the id is 0 before it is accepted.
    pub fn input(&self, index: usize) -> Option<(u8, &SessionRecipe)> {
        self.inputs.get(index).map(|(id, recipe)| (*id, recipe))
    }

    /// Requested packages per second.
    pub fn frequency_hz(&self) -> f64 {
        let max = self.controller.map_or(500.0, |v| v.max_frequency_hz());
        match (self.version, self.frequency_hz) {
            // Version 1 has no frequency: the controller sends a package in every step.
            (Version::V1, _) => max,
            (Version::V2, Some(hz)) if hz.is_finite() && hz > 0.0 => hz.min(max),
            (Version::V2, _) => max,
        }
    }

    /// Writes the next message of the handshake and returns its length; `None` while an answer is awaited or after the
    /// handshake.
    ///
    /// # Errors
    /// `out` is too small, or a name list too long.
    pub fn transmit(&mut self, out: &mut [u8]) -> Result<Option<usize>, ClientError> {
        if self.awaiting {
            return Ok(None);
        }
        let mut list = [0u8; MAX_NAME_LIST];
        let message = match self.phase {
            Phase::Version(version) => ClientMessage::RequestVersion(version.number()),
            Phase::Identity => ClientMessage::GetControllerVersion,
            Phase::Outputs => ClientMessage::SetupOutputs {
                frequency_hz: Some(self.frequency_hz()),
                names: name_list(self.outputs.entries(), &mut list)?,
            },
            Phase::Inputs(i) => match self.inputs.get(i) {
                Some((_, recipe)) => ClientMessage::SetupInputs { names: name_list(recipe.entries(), &mut list)? },
                None => return Ok(None),
            },
            Phase::Starting => ClientMessage::Start,
            Phase::Running | Phase::Paused => return Ok(None),
        };
        let n = message.emit(self.version, out).map_err(ClientError::NoRoom)?;
        self.awaiting = true;
        Ok(Some(n))
    }

    /// Takes a package from the controller.
    ///
    /// # Errors
    /// The session cannot continue; close the connection.
    pub fn handle<'a>(&mut self, package: Package<'a>) -> Result<Event<'a>, ClientError> {
        let message = ControllerMessage::parse(self.version, package)?;
        match message {
            ControllerMessage::Text(text) => return Ok(Event::Text(text)),
            ControllerMessage::Data { recipe, values } => return self.data(recipe, values),
            ControllerMessage::Paused(_) => {
                self.phase = Phase::Paused;
                return Ok(Event::Paused);
            }
            _ => {}
        }
        let kind = Kind::from_byte(package.kind).ok_or(MessageError::UnknownKind(package.kind))?;
        if !self.awaiting {
            return Err(ClientError::Unexpected(kind));
        }
        self.phase = match (self.phase, message) {
            (Phase::Version(version), ControllerMessage::VersionAccepted(true)) => {
                self.version = version;
                Phase::Identity
            }
            (Phase::Version(Version::V2), ControllerMessage::VersionAccepted(false)) => Phase::Version(Version::V1),
            (Phase::Version(Version::V1), ControllerMessage::VersionAccepted(false)) => {
                return Err(ClientError::VersionRefused);
            }
            (Phase::Identity, ControllerMessage::ControllerVersion(version)) => {
                self.controller = Some(version);
                Phase::Outputs
            }
            (Phase::Outputs, ControllerMessage::OutputsSetUp { recipe, types }) => {
                check_types(Side::Output, self.outputs.entries(), types)?;
                self.output_id = recipe;
                self.next_input(0)
            }
            (Phase::Inputs(i), ControllerMessage::InputsSetUp { recipe, types }) => {
                if let Some((id, fields)) = self.inputs.get_mut(i) {
                    check_types(Side::Input, fields.entries(), types)?;
                    if recipe == 0 {
                        return Err(ClientError::NoRecipeId);
                    }
                    *id = recipe;
                }
                self.next_input(i + 1)
            }
            (Phase::Starting, ControllerMessage::Started(true)) => Phase::Running,
            (Phase::Starting, ControllerMessage::Started(false)) => return Err(ClientError::StartRefused),
            _ => return Err(ClientError::Unexpected(kind)),
        };
        self.awaiting = false;
        Ok(Event::Progress)
    }

    fn next_input(&self, i: usize) -> Phase {
        if i < self.inputs.len() { Phase::Inputs(i) } else { Phase::Starting }
    }

    /// Data may arrive before the answer to S is read, and after P.
    #[inline]
    fn data<'a>(&self, recipe: Option<u8>, values: &'a [u8]) -> Result<Event<'a>, ClientError> {
        if !matches!(self.phase, Phase::Starting | Phase::Running | Phase::Paused) {
            return Err(ClientError::Unexpected(Kind::Data));
        }
        match recipe {
            Some(id) if Some(id) != self.output_id => return Err(ClientError::WrongRecipe(id)),
            _ => {}
        }
        if values.len() != self.outputs.size() {
            return Err(ClientError::DataLength { expected: self.outputs.size(), found: values.len() });
        }
        Ok(Event::Data(values))
    }
}

fn name_list<'o>(entries: &[Entry], out: &'o mut [u8]) -> Result<&'o str, ClientError> {
    join(entries.iter().map(|e| e.field), out).map_err(|_| ClientError::NameList)
}

/// Checks that there is one entry of the expected type for each field. The entries are compared before their number, so
/// that a refused field is named even if an old controller ends its list there.
fn check_types(side: Side, fields: &[Entry], types: &str) -> Result<(), ClientError> {
    for (entry, answer) in fields.iter().zip(answers(types)) {
        match answer {
            Some(Answer::NotFound) => return Err(ClientError::NotFound(entry.field)),
            Some(Answer::InUse) => return Err(ClientError::InUse(entry.field)),
            Some(Answer::Type(found)) if found != entry.field.kind() => {
                return Err(ClientError::WrongType { field: entry.field, found });
            }
            Some(Answer::Type(_)) => {}
            None => return Err(ClientError::WrongList(side)),
        }
    }
    if answers(types).count() == fields.len() { Ok(()) } else { Err(ClientError::WrongList(side)) }
}
