//! The controller's side of one RTDE connection, without a socket: bytes in, answers and effects on the robot out.

use super::link_faults::RtdeFaults;
use super::robot::Robot;
use super::variables::Output;
use graspd_rt::rtde::{Field, FrameError, Framer, INPUT_COUNT, MAX_PACKAGE, Side, Value};

/// Number of a connection; never reused.
pub type ClientId = u64;

/// Which connection owns which RTDE input.
#[derive(Clone, Debug)]
pub struct Ownership([Option<ClientId>; INPUT_COUNT]);

impl Default for Ownership {
    fn default() -> Self {
        Ownership([None; INPUT_COUNT])
    }
}

impl Ownership {
    /// Releases all inputs of a connection.
    pub fn release(&mut self, client: ClientId) {
        for owner in &mut self.0 {
            if *owner == Some(client) {
                *owner = None;
            }
        }
    }

    fn is_free(&self, field: Field, client: ClientId) -> bool {
        self.0.get(field.index()).is_some_and(|owner| owner.is_none_or(|o| o == client))
    }

    fn claim(&mut self, field: Field, client: ClientId) {
        if let Some(owner) = self.0.get_mut(field.index()) {
            *owner = Some(client);
        }
    }
}

/// Package types, both directions.
mod kind {
    pub(super) const REQUEST_VERSION: u8 = 86;
    pub(super) const CONTROL_VERSION: u8 = 118;
    pub(super) const TEXT: u8 = 77;
    pub(super) const DATA: u8 = 85;
    pub(super) const SETUP_OUTPUTS: u8 = 79;
    pub(super) const SETUP_INPUTS: u8 = 73;
    pub(super) const START: u8 = 83;
    pub(super) const PAUSE: u8 = 80;
}

/// Input recipes of one connection; a recipe id is one byte and 0 means none.
const MAX_RECIPES: usize = 255;

/// One RTDE connection.
pub struct RtdeSession {
    client: ClientId,
    framer: Framer<Vec<u8>>,
    version: u16,
    outputs: Option<OutputRecipe>,
    /// Number of the output recipe set up last, for its id.
    output_setups: u8,
    inputs: Vec<Vec<Field>>,
    started: bool,
    /// Data packages received.
    pub received: u64,
}

struct OutputRecipe {
    id: u8,
    fields: Vec<Output>,
    /// Control steps between packages; may be fractional.
    period: f64,
    /// Steps until the next package.
    left: f64,
}

/// One input package, as applied to the robot.
pub struct InputPackage {
    /// Connection that sent it.
    pub client: ClientId,
    /// Its fields in recipe order.
    pub values: Vec<(Field, Value)>,
}

impl RtdeSession {
    /// A new connection, in protocol version 1.
    pub fn new(client: ClientId) -> Self {
        RtdeSession {
            client,
            framer: Framer::new(vec![0; MAX_PACKAGE]),
            version: 1,
            outputs: None,
            output_setups: 0,
            inputs: Vec::new(),
            started: false,
            received: 0,
        }
    }

    /// Takes received bytes, however they are split. Appends answers to `out`; applies input packages to the robot and
    /// passes them to `note`.
    ///
    /// # Errors
    /// Framing is lost: the connection must be closed.
    pub fn receive(
        &mut self,
        mut bytes: &[u8],
        robot: &mut Robot,
        owners: &mut Ownership,
        faults: &RtdeFaults,
        out: &mut Vec<u8>,
        note: &mut dyn FnMut(InputPackage),
    ) -> Result<(), FrameError> {
        while !bytes.is_empty() {
            let taken = self.framer.feed(bytes);
            bytes = bytes.get(taken..).unwrap_or_default();
            // Copied, because an answer borrows the whole session; a package is at most 64 KiB.
            while let Some((kind, body)) = self.framer.next()?.map(|p| (p.kind, p.body.to_vec())) {
                self.package(kind, &body, robot, owners, faults, out, note);
            }
        }
        Ok(())
    }

    #[expect(clippy::too_many_arguments, reason = "the parts of the world that one package may change")]
    fn package(
        &mut self,
        kind: u8,
        body: &[u8],
        robot: &mut Robot,
        owners: &mut Ownership,
        faults: &RtdeFaults,
        out: &mut Vec<u8>,
        note: &mut dyn FnMut(InputPackage),
    ) {
        match kind {
            kind::REQUEST_VERSION => {
                let asked = body.first_chunk::<2>().map_or(0, |b| u16::from_be_bytes(*b));
                let accepted = asked == 1 || asked == 2 && !faults.refuse_v2;
                if accepted {
                    self.version = asked;
                }
                put(out, kind, &[u8::from(accepted)]);
            }
            kind::CONTROL_VERSION => {
                let words = robot.setup.model.software().map(u32::to_be_bytes);
                put(out, kind, words.as_flattened());
            }
            kind::SETUP_OUTPUTS => self.setup_outputs(body, robot, faults, out),
            kind::SETUP_INPUTS => self.setup_inputs(body, owners, faults, out),
            kind::START | kind::PAUSE => {
                self.started = kind == kind::START;
                put(out, kind, &[1]);
            }
            kind::DATA => match self.decode(body) {
                Some(values) => {
                    self.received += 1;
                    robot.apply_inputs(&values);
                    note(InputPackage { client: self.client, values });
                }
                None => self.complain(out, "data package does not match an input recipe"),
            },
            kind::TEXT => {}
            _ => self.complain(out, "unknown package type"),
        }
    }

    /// Sends a text message to the client.
    fn complain(&self, out: &mut Vec<u8>, text: &str) {
        const WARNING: u8 = 2;
        let mut body = Vec::with_capacity(text.len() + 16);
        if self.version == 1 {
            body.push(WARNING);
            body.extend_from_slice(text.as_bytes());
        } else {
            for part in [text, "RTDE"] {
                body.push(part.len() as u8);
                body.extend_from_slice(part.as_bytes());
            }
            body.push(WARNING);
        }
        put(out, kind::TEXT, &body);
    }

    fn setup_outputs(&mut self, body: &[u8], robot: &Robot, faults: &RtdeFaults, out: &mut Vec<u8>) {
        let top = robot.setup.rate_hz;
        let (frequency, names) = match body.split_first_chunk::<8>() {
            Some((f, names)) if self.version == 2 => (f64::from_be_bytes(*f), names),
            _ if self.version == 2 => (top, &[][..]),
            _ => (top, body),
        };
        // The documents do not define frequencies outside (0, maximum]; the maximum is the most tolerant choice.
        let frequency = if frequency > 0.0 && frequency <= top { frequency } else { top };
        let mut words = Vec::new();
        let mut fields = Vec::new();
        for name in split_names(names) {
            match Field::find(Side::Output, &name).filter(|_| !faults.not_found.contains(&name)) {
                Some(field) => {
                    fields.push(Output::new(field));
                    words.push(faults.type_name(&name, field.kind().name()));
                }
                None => words.push("NOT_FOUND"),
            }
        }
        let complete = fields.len() == words.len() && !fields.is_empty();
        let id = if complete {
            self.output_setups = self.output_setups.checked_add(1).unwrap_or(1);
            self.output_setups
        } else {
            0
        };
        self.outputs = complete.then(|| OutputRecipe { id, fields, period: top / frequency, left: 1.0 });
        let types = words.join(",");
        let mut answer = Vec::with_capacity(types.len() + 1);
        if self.version == 2 {
            answer.push(id);
        }
        answer.extend_from_slice(types.as_bytes());
        put(out, kind::SETUP_OUTPUTS, &answer);
    }

    fn setup_inputs(&mut self, body: &[u8], owners: &mut Ownership, faults: &RtdeFaults, out: &mut Vec<u8>) {
        let mut words = Vec::new();
        let mut fields = Vec::new();
        for name in split_names(body) {
            match Field::find(Side::Input, &name).filter(|_| !faults.not_found.contains(&name)) {
                None => words.push("NOT_FOUND"),
                Some(f) if faults.in_use.contains(&name) || !owners.is_free(f, self.client) => words.push("IN_USE"),
                Some(field) => {
                    fields.push(field);
                    words.push(faults.type_name(&name, field.kind().name()));
                }
            }
        }
        // An incomplete recipe gets no id and owns none of its inputs.
        let complete = fields.len() == words.len() && !fields.is_empty() && self.inputs.len() < MAX_RECIPES;
        let mut id = 0;
        if complete {
            for &field in &fields {
                owners.claim(field, self.client);
            }
            self.inputs.push(fields);
            id = self.inputs.len() as u8;
        }
        let mut answer = vec![id];
        answer.extend_from_slice(words.join(",").as_bytes());
        put(out, kind::SETUP_INPUTS, &answer);
    }

    /// Values of an input package; `None` if the recipe is unknown or the length does not match it.
    fn decode(&self, body: &[u8]) -> Option<Vec<(Field, Value)>> {
        let (&id, mut rest) = body.split_first()?;
        let recipe = self.inputs.get(usize::from(id).checked_sub(1)?)?;
        let mut values = Vec::with_capacity(recipe.len());
        for &field in recipe {
            values.push((field, Value::decode(field.kind(), rest)?));
            rest = rest.get(field.kind().size()..)?;
        }
        rest.is_empty().then_some(values)
    }

    /// Counts one control step. Appends a data package to `out` and returns true if one is due.
    pub fn sample(&mut self, robot: &Robot, out: &mut Vec<u8>) -> bool {
        let version = self.version;
        let Some(recipe) = self.outputs.as_mut().filter(|_| self.started) else { return false };
        recipe.left -= 1.0;
        if recipe.left > 1e-9 {
            return false;
        }
        recipe.left += recipe.period;
        let start = out.len();
        out.extend_from_slice(&[0, 0, kind::DATA]);
        if version == 2 {
            out.push(recipe.id);
        }
        for field in &recipe.fields {
            let mut bytes = [0; 48];
            let n = field.value(robot).encode(&mut bytes).unwrap_or(0);
            out.extend_from_slice(&bytes[..n.min(48)]);
        }
        seal(out, start);
        true
    }
}

/// Names of a recipe; SDU's client ends its list with a comma, which adds no name.
fn split_names(bytes: &[u8]) -> Vec<String> {
    bytes
        .split(|b| *b == b',')
        .filter(|part| !part.is_empty())
        .map(|part| String::from_utf8_lossy(part).into_owned())
        .collect()
}

/// Appends one package.
pub(super) fn put(out: &mut Vec<u8>, kind: u8, body: &[u8]) {
    let start = out.len();
    out.extend_from_slice(&[0, 0, kind]);
    out.extend_from_slice(body);
    seal(out, start);
}

/// Fills in the size of the package that begins at `start`; removes a package that is too long for the size field.
fn seal(out: &mut Vec<u8>, start: usize) {
    match u16::try_from(out.len() - start) {
        Ok(size) => {
            if let Some(head) = out.get_mut(start..start + 2) {
                head.copy_from_slice(&size.to_be_bytes());
            }
        }
        Err(_) => out.truncate(start),
    }
}
