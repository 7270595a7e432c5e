//! The wire record: every input package with its receive time and every control step in one binary file.
//!
//! Little-endian. The file begins with the eight bytes `URWIRE01`. Records follow, each a kind byte and a body whose
//! length follows from the kind:
//!
//! - `I` input package: u64 receive time ns, u64 client, u8 count, then for each field u16 number (RTDE input list), u8
//!   length and the value's bytes as on the wire.
//! - `S` control step: u64 time ns, f64 controller time, six f64 each of target position, target speed, position, speed
//!   (rad, rad/s), u8 robot mode, u8 safety mode, u8 runtime state.
//! - `N` note: u64 time ns, u16 length, UTF-8 text (faults, connections, uploads).

use super::judge::{Judge, Limits, StepSample, Summary};
use super::robot::Robot;
use super::rtde_session::InputPackage;
use crate::plant::Joints;
use crossbeam::channel::{Receiver, Sender, bounded};
use graspd_rt::rtde::{Field, Side, Value};
use std::io::{BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::thread::JoinHandle;

const MAGIC: &[u8; 8] = b"URWIRE01";
/// Blocks queued for the disk; further ones are dropped and counted, because the control step must not wait.
const MAX_QUEUED_BLOCKS: usize = 1024;
/// Size at which a block is queued.
const BLOCK_BYTES: usize = 16 * 1024;

/// Writes the record on a separate thread.
pub struct Recorder {
    block: Vec<u8>,
    queue: Option<Sender<Vec<u8>>>,
    writer: Option<JoinHandle<std::io::Result<()>>>,
    /// Blocks dropped because the disk was too slow.
    pub dropped: u64,
}

impl Recorder {
    /// Creates the file.
    pub fn create(path: &Path) -> std::io::Result<Self> {
        let mut file = BufWriter::new(std::fs::File::create(path)?);
        file.write_all(MAGIC)?;
        let (queue, blocks): (Sender<Vec<u8>>, Receiver<Vec<u8>>) = bounded(MAX_QUEUED_BLOCKS);
        let writer = std::thread::Builder::new().name("record".to_owned()).spawn(move || {
            for block in blocks {
                file.write_all(&block)?;
                // The file can be read while the mock runs.
                file.flush()?;
            }
            file.flush()
        })?;
        Ok(Recorder {
            block: Vec::with_capacity(2 * BLOCK_BYTES),
            queue: Some(queue),
            writer: Some(writer),
            dropped: 0,
        })
    }

    /// Records one input package.
    pub fn input(&mut self, at_ns: u64, package: &InputPackage) {
        self.block.push(b'I');
        self.block.extend_from_slice(&at_ns.to_le_bytes());
        self.block.extend_from_slice(&package.client.to_le_bytes());
        self.block.push(package.values.len().min(255) as u8);
        for (field, value) in package.values.iter().take(255) {
            let mut bytes = [0; 48];
            let n = value.encode(&mut bytes).unwrap_or(0).min(48);
            self.block.extend_from_slice(&(field.index() as u16).to_le_bytes());
            self.block.push(n as u8);
            self.block.extend_from_slice(&bytes[..n]);
        }
        self.queue_block(BLOCK_BYTES);
    }

    /// Records one control step.
    pub fn step(&mut self, at_ns: u64, robot: &Robot) {
        self.block.push(b'S');
        self.block.extend_from_slice(&at_ns.to_le_bytes());
        self.block.extend_from_slice(&robot.clock_s.to_le_bytes());
        let t = &robot.truth;
        for v in [&t.target_q, &t.target_qd, &t.actual_q, &t.actual_qd] {
            for x in v {
                self.block.extend_from_slice(&x.to_le_bytes());
            }
        }
        self.block.extend_from_slice(&[robot.mode as u8, robot.safety as u8, robot.runtime as u8]);
        self.queue_block(BLOCK_BYTES);
    }

    /// Records an event.
    pub fn note(&mut self, at_ns: u64, text: &str) {
        let text = super::message::cut(text);
        self.block.push(b'N');
        self.block.extend_from_slice(&at_ns.to_le_bytes());
        self.block.extend_from_slice(&(text.len() as u16).to_le_bytes());
        self.block.extend_from_slice(text.as_bytes());
        self.queue_block(BLOCK_BYTES);
    }

    /// Queues everything for writing.
    pub fn flush(&mut self) {
        self.queue_block(1);
    }

    fn queue_block(&mut self, min_bytes: usize) {
        if self.block.len() < min_bytes {
            return;
        }
        let block = std::mem::replace(&mut self.block, Vec::with_capacity(2 * BLOCK_BYTES));
        if self.queue.as_ref().is_none_or(|t| t.try_send(block).is_err()) {
            self.dropped += 1;
        }
    }

    /// Writes the rest and closes the file.
    pub fn finish(mut self) -> std::io::Result<()> {
        self.flush();
        self.queue = None;
        match self.writer.take().map(JoinHandle::join) {
            Some(Ok(result)) => result,
            _ => Ok(()),
        }
    }
}

/// One record, as read from a file.
#[derive(Clone, Debug, PartialEq)]
pub enum Entry {
    /// An input package.
    Input {
        /// Receive time, ns.
        at_ns: u64,
        /// Connection.
        client: u64,
        /// Its fields.
        values: Vec<(Field, Value)>,
    },
    /// A control step.
    Step {
        /// Time, ns.
        at_ns: u64,
        /// Controller time, s.
        clock_s: f64,
        /// Target positions, target speeds, positions, speeds.
        joints: [Joints; 4],
        /// Robot mode, safety mode, runtime state.
        modes: [u8; 3],
    },
    /// An event.
    Note {
        /// Time, ns.
        at_ns: u64,
        /// Description.
        text: String,
    },
}

/// A record could not be read.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The file cannot be read.
    #[error("wire record {0}: {1}")]
    Io(PathBuf, std::io::Error),
    /// The file is not a wire record, or of another version.
    #[error("wire record {0}: does not begin with URWIRE01; record it again with this graspd-mock-ur")]
    Magic(PathBuf),
    /// A record has an unknown kind.
    #[error("wire record {0}: unknown record kind {1} at byte {2}; the file is damaged from there on")]
    Kind(PathBuf, u8, usize),
}

/// Reads a record. A truncated last entry (the mock was killed) is ignored.
pub fn read(path: &Path) -> Result<Vec<Entry>, RecordError> {
    let mut bytes = Vec::new();
    std::fs::File::open(path)
        .and_then(|mut f| f.read_to_end(&mut bytes))
        .map_err(|e| RecordError::Io(path.to_owned(), e))?;
    let body = bytes.strip_prefix(MAGIC).ok_or_else(|| RecordError::Magic(path.to_owned()))?;
    let mut reader = Reader { bytes: body };
    let mut entries = Vec::new();
    while let Some(&kind) = reader.bytes.first() {
        let at = bytes.len() - reader.bytes.len();
        reader.bytes = reader.bytes.get(1..).unwrap_or_default();
        let entry = match kind {
            b'I' => reader.input(),
            b'S' => reader.step(),
            b'N' => reader.note(),
            other => return Err(RecordError::Kind(path.to_owned(), other, at)),
        };
        match entry {
            Some(entry) => entries.push(entry),
            None => break,
        }
    }
    Ok(entries)
}

/// Judges a record.
pub fn judge(entries: &[Entry], limits: Limits) -> Summary {
    let mut judge = Judge::new(limits);
    let mut last_qd = [0.0; 6];
    for entry in entries {
        match entry {
            Entry::Input { at_ns, values, .. } => judge.input(*at_ns, values),
            Entry::Step { at_ns, joints: [_, target_qd, q, qd], .. } => {
                let target_qdd = std::array::from_fn(|i| (target_qd[i] - last_qd[i]) / limits.step_s);
                judge.step(&StepSample { at_ns: *at_ns, q: *q, qd: *qd, target_qd: *target_qd, target_qdd });
                last_qd = *target_qd;
            }
            Entry::Note { .. } => {}
        }
    }
    judge.summary()
}

struct Reader<'a> {
    bytes: &'a [u8],
}

impl<'a> Reader<'a> {
    fn take(&mut self, n: usize) -> Option<&'a [u8]> {
        let (head, rest) = self.bytes.split_at_checked(n)?;
        self.bytes = rest;
        Some(head)
    }

    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        self.take(N)?.first_chunk::<N>().copied()
    }

    fn f64(&mut self) -> Option<f64> {
        self.array().map(f64::from_le_bytes)
    }

    fn input(&mut self) -> Option<Entry> {
        let at_ns = u64::from_le_bytes(self.array()?);
        let client = u64::from_le_bytes(self.array()?);
        let [count] = self.array()?;
        let mut values = Vec::with_capacity(usize::from(count));
        for _ in 0..count {
            let number = usize::from(u16::from_le_bytes(self.array()?));
            let [length] = self.array()?;
            let bytes = self.take(usize::from(length))?;
            let field = Field::all(Side::Input).nth(number)?;
            values.push((field, Value::decode(field.kind(), bytes)?));
        }
        Some(Entry::Input { at_ns, client, values })
    }

    fn step(&mut self) -> Option<Entry> {
        let at_ns = u64::from_le_bytes(self.array()?);
        let clock_s = self.f64()?;
        let mut joints = [[0.0; 6]; 4];
        for v in joints.as_flattened_mut() {
            *v = self.f64()?;
        }
        Some(Entry::Step { at_ns, clock_s, joints, modes: self.array()? })
    }

    fn note(&mut self) -> Option<Entry> {
        let at_ns = u64::from_le_bytes(self.array()?);
        let length = usize::from(u16::from_le_bytes(self.array()?));
        let text = String::from_utf8_lossy(self.take(length)?).into_owned();
        Some(Entry::Note { at_ns, text })
    }
}
