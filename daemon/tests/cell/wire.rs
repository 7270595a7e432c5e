//! Reader of the mock's wire record while it grows: the commands and the arm's motion in the order in which the mock
//! processed them. Controller times are the mock's clock, which stalls together with the mock.

use graspd_rt::rtde::Field;
use std::io::{Read, Seek, SeekFrom};
use std::path::PathBuf;

/// One entry of the record.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Entry {
    /// A command with this heartbeat, mode word and rates (rad/s), and when the mock received it (ns of
    /// CLOCK_MONOTONIC).
    Heartbeat { heartbeat: i32, mode: i32, at_ns: u64, rates: [f64; 6] },
    /// A control step: controller time, target speed and true speed of the fastest joint (rad/s), and when the mock
    /// made it (ns).
    Step { clock_s: f64, target: f64, speed: f64, at_ns: u64 },
    /// An event, as text.
    Note(String),
}

/// A reader that keeps its position.
pub(crate) struct Wire {
    path: PathBuf,
    at: u64,
    rest: Vec<u8>,
}

impl Wire {
    pub(crate) fn open(path: PathBuf) -> Self {
        Self { path, at: 8, rest: Vec::new() }
    }

    /// The entries since the last call.
    pub(crate) fn read(&mut self) -> Vec<Entry> {
        let mut file = std::fs::File::open(&self.path).unwrap();
        file.seek(SeekFrom::Start(self.at)).unwrap();
        self.at += file.read_to_end(&mut self.rest).unwrap() as u64;
        let (mut out, mut used) = (Vec::new(), 0);
        while let Some((entry, n)) = parse(self.rest.get(used..).unwrap_or_default()) {
            out.extend(entry);
            used += n;
        }
        self.rest.drain(..used);
        out
    }
}

fn f64_at(b: &[u8], i: usize) -> f64 {
    f64::from_le_bytes(b[i..i + 8].try_into().unwrap())
}

fn fastest(b: &[u8], i: usize) -> f64 {
    (0..6).fold(0.0, |m: f64, k| m.max(f64_at(b, i + 8 * k).abs()))
}

/// The first entry and its length; `None` while it is incomplete.
fn parse(b: &[u8]) -> Option<(Option<Entry>, usize)> {
    match *b.first()? {
        b'I' => input(b),
        b'S' => {
            let n = 1 + 8 + 8 + 4 * 48 + 3;
            let b = b.get(..n)?;
            let at_ns = u64::from_le_bytes(b[1..9].try_into().unwrap());
            let step =
                Entry::Step { clock_s: f64_at(b, 9), target: fastest(b, 17 + 48), speed: fastest(b, 17 + 144), at_ns };
            Some((Some(step), n))
        }
        b'N' => {
            let n = 11 + usize::from(u16::from_le_bytes(b.get(9..11)?.try_into().unwrap()));
            let text = String::from_utf8_lossy(b.get(11..n)?).into_owned();
            Some((Some(Entry::Note(text)), n))
        }
        other => panic!("unknown entry kind {other} in the wire record"),
    }
}

fn input(b: &[u8]) -> Option<(Option<Entry>, usize)> {
    let number = |name: &str| Field::input(name).unwrap().index() as u16;
    let (mode_field, heartbeat_field) = (number("input_int_register_24"), number("input_int_register_25"));
    let first_rate = number("input_double_register_24");
    let (mut n, mut found, mut mode, mut rates) = (18, None, 0, [0.0; 6]);
    let at_ns = u64::from_le_bytes(b.get(1..9)?.try_into().unwrap());
    for _ in 0..*b.get(17)? {
        let field = u16::from_le_bytes(b.get(n..n + 2)?.try_into().unwrap());
        let length = usize::from(*b.get(n + 2)?);
        let value = b.get(n + 3..n + 3 + length)?;
        // Values are recorded as on the wire, in network byte order.
        let int = || i32::from_be_bytes(value.try_into().unwrap());
        if field == heartbeat_field {
            found = Some(int());
        } else if field == mode_field {
            mode = int();
        } else if (first_rate..first_rate + 6).contains(&field) {
            rates[usize::from(field - first_rate)] = f64::from_be_bytes(value.try_into().unwrap());
        }
        n += 3 + length;
    }
    Some((found.map(|heartbeat| Entry::Heartbeat { heartbeat, mode, at_ns, rates }), n))
}
