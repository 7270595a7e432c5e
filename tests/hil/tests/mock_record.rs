//! The wire record, parsed according to the table in docs/MOCK-UR.md only.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_hil::controller::{Command, Entry, Hosted, Setup, now_ns, read_record};
use graspd_hil::plant::Model;
use graspd_rt::rtde::{Field, Side};
use std::io::{Read, Write};

struct Bytes<'a>(&'a [u8]);

impl Bytes<'_> {
    fn take<const N: usize>(&mut self) -> [u8; N] {
        let (head, rest) = self.0.split_first_chunk::<N>().expect("the record is cut off");
        self.0 = rest;
        *head
    }
    fn u64(&mut self) -> u64 {
        u64::from_le_bytes(self.take())
    }
    fn f64(&mut self) -> f64 {
        f64::from_le_bytes(self.take())
    }
    fn skip(&mut self, n: usize) -> Vec<u8> {
        let (head, rest) = self.0.split_at(n);
        self.0 = rest;
        head.to_vec()
    }
}

#[test]
fn a_record_has_the_documented_format() {
    let path = std::env::temp_dir().join(format!("graspd-record-{}-{}.rec", std::process::id(), now_ns()));
    let setup = Setup::new(Model::by_name("ur5e").unwrap());
    let mut mock = Hosted::start(setup, None, Some(path.clone())).unwrap();
    let mut s = mock.connect(30004).unwrap();
    let mut put = |kind: u8, body: &[u8]| {
        let mut p = ((body.len() + 3) as u16).to_be_bytes().to_vec();
        p.push(kind);
        p.extend_from_slice(body);
        s.write_all(&p).unwrap();
    };
    put(86, &[0, 2]);
    put(73, b"input_double_register_24,input_int_register_25");
    put(85, &[&[1][..], &0.25f64.to_be_bytes(), &77i32.to_be_bytes()].concat());
    // Both answers have arrived, so all earlier messages have been handled.
    s.read_exact(&mut [0; 4 + 3 + 13]).unwrap();
    let begin = std::time::Instant::now();
    while mock.ask(&Command::State).unwrap()["steps"].as_u64().unwrap() < 5 {
        assert!(begin.elapsed() < std::time::Duration::from_secs(20));
    }
    mock.ask(&Command::ProtectiveStop).unwrap();
    std::thread::sleep(std::time::Duration::from_millis(50));
    mock.stop();

    let file = std::fs::read(&path).unwrap();
    let entries = read_record(&path).unwrap();
    std::fs::remove_file(&path).unwrap();
    assert_eq!(&file[..8], b"URWIRE01");
    let mut b = Bytes(&file[8..]);
    let names: Vec<String> = Field::all(Side::Input).map(|f| f.to_string()).collect();
    let (mut steps, mut inputs, mut notes, mut last) = (0, Vec::new(), Vec::new(), 0);
    let mut modes = Vec::new();
    let mut records = 0;
    while let Some((&kind, rest)) = b.0.split_first() {
        b.0 = rest;
        records += 1;
        let at = b.u64();
        assert!(at >= last, "times go forward");
        last = at;
        match kind {
            b'I' => {
                b.u64();
                let [count] = b.take();
                for _ in 0..count {
                    let number = u16::from_le_bytes(b.take());
                    let [length] = b.take();
                    inputs.push((names[usize::from(number)].clone(), b.skip(usize::from(length))));
                }
            }
            b'S' => {
                steps += 1;
                let clock = b.f64();
                assert!((60.0..600.0).contains(&clock));
                let joints: Vec<f64> = (0..24).map(|_| b.f64()).collect();
                assert!(joints.iter().all(|v| v.is_finite() && v.abs() < 7.0));
                modes.push(b.take::<3>());
            }
            b'N' => {
                let n = usize::from(u16::from_le_bytes(b.take()));
                notes.push(String::from_utf8(b.skip(n)).unwrap());
            }
            other => panic!("a record of kind {other}"),
        }
    }
    assert!(steps > 10, "{steps} steps");
    let expected = [
        ("input_double_register_24".to_owned(), 0.25f64.to_be_bytes().to_vec()),
        ("input_int_register_25".to_owned(), 77i32.to_be_bytes().to_vec()),
    ];
    assert_eq!(inputs, expected);
    assert_eq!((modes[0], modes.last().copied().unwrap()), ([7, 1, 1], [7, 3, 1]), "running, normal, then stopped");
    for part in [" Rtde from ", "protective_stop", "stopped"] {
        assert!(notes.iter().any(|n| n.contains(part)), "{part}: {notes:?}");
    }
    // The library's reader agrees.
    assert_eq!(entries.len(), records);
    assert_eq!(entries.iter().filter(|e| matches!(e, Entry::Step { .. })).count(), steps);
}
