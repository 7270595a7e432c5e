//! RTDE compared with literal bytes, fed with arbitrary bytes, and a client and a server joined in memory.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_rt::arm::{ArmCommand, ArmMode};
use graspd_rt::rtde::*;
use proptest::prelude::*;

fn package(bytes: &[u8]) -> Package<'_> {
    assert_eq!(u16::from_be_bytes([bytes[0], bytes[1]]) as usize, bytes.len());
    Package { kind: bytes[2], body: &bytes[3..] }
}

fn client_case(version: Version, message: ClientMessage<'_>, bytes: &[u8]) {
    let mut out = [0u8; 256];
    let n = message.emit(version, &mut out).unwrap();
    assert_eq!(&out[..n], bytes, "{message:?}");
    assert_eq!(ClientMessage::parse(version, package(bytes)), Ok(message));
    assert_eq!(message.emit(version, &mut out[..n - 1]), Err(NoRoom { needed: n }));
}

fn controller_case(version: Version, message: ControllerMessage<'_>, bytes: &[u8]) {
    let mut out = [0u8; 256];
    let n = message.emit(version, &mut out).unwrap();
    assert_eq!(&out[..n], bytes, "{message:?}");
    assert_eq!(ControllerMessage::parse(version, package(bytes)), Ok(message));
    assert_eq!(message.emit(version, &mut out[..n - 1]), Err(NoRoom { needed: n }));
}

// The literals follow the struct formats of UR's Python client: '>HB' header, '>H' version, '>IIII' identity, '>d'
// frequency.
#[test]
fn every_message_of_a_client_has_its_literal_bytes() {
    use ClientMessage::*;
    use Version::{V1, V2};
    client_case(V1, RequestVersion(2), b"\x00\x05V\x00\x02");
    client_case(V2, GetControllerVersion, b"\x00\x03v");
    let text = graspd_rt::rtde::Text { level: Level::Warning, message: b"hi", source: b"me" };
    client_case(V2, Text(text), b"\x00\x0aM\x02hi\x02me\x02");
    client_case(V1, Text(graspd_rt::rtde::Text { source: b"", ..text }), b"\x00\x06M\x02hi");
    client_case(V2, Data { recipe: 3, values: &[9, 8] }, b"\x00\x06U\x03\x09\x08");
    client_case(
        V2,
        SetupOutputs { frequency_hz: Some(125.0), names: "timestamp" },
        b"\x00\x14O\x40\x5f\x40\x00\x00\x00\x00\x00timestamp",
    );
    client_case(V1, SetupOutputs { frequency_hz: None, names: "timestamp," }, b"\x00\x0dOtimestamp,");
    client_case(V2, SetupInputs { names: "a,b" }, b"\x00\x06Ia,b");
    client_case(V2, Start, b"\x00\x03S");
    client_case(V2, Pause, b"\x00\x03P");
}

#[test]
fn every_message_of_a_controller_has_its_literal_bytes() {
    use ControllerMessage::*;
    use Version::{V1, V2};
    controller_case(V1, VersionAccepted(true), b"\x00\x04V\x01");
    controller_case(V1, VersionAccepted(false), b"\x00\x04V\x00");
    let v = graspd_rt::rtde::ControllerVersion { major: 5, minor: 11, bugfix: 0, build: 108_249 };
    controller_case(V2, ControllerVersion(v), b"\x00\x13v\0\0\0\x05\0\0\0\x0b\0\0\0\0\x00\x01\xa6\xd9");
    let text = graspd_rt::rtde::Text { level: Level::Exception, message: b"no", source: b"RTDE" };
    controller_case(V2, Text(text), b"\x00\x0cM\x02no\x04RTDE\x00");
    controller_case(V1, Text(graspd_rt::rtde::Text { source: b"", ..text }), b"\x00\x06M\x00no");
    controller_case(V2, Data { recipe: Some(1), values: &[7] }, b"\x00\x05U\x01\x07");
    controller_case(V1, Data { recipe: None, values: &[7] }, b"\x00\x04U\x07");
    controller_case(V2, OutputsSetUp { recipe: Some(1), types: "DOUBLE" }, b"\x00\x0aO\x01DOUBLE");
    controller_case(V1, OutputsSetUp { recipe: None, types: "DOUBLE" }, b"\x00\x09ODOUBLE");
    controller_case(V2, InputsSetUp { recipe: 0, types: "IN_USE" }, b"\x00\x0aI\x00IN_USE");
    controller_case(V2, Started(true), b"\x00\x04S\x01");
    controller_case(V2, Paused(false), b"\x00\x04P\x00");
}

#[test]
fn malformed_messages_are_named() {
    let parse = |bytes: &'static [u8]| ControllerMessage::parse(Version::V2, package(bytes));
    assert_eq!(parse(b"\x00\x03Z"), Err(MessageError::UnknownKind(b'Z')));
    assert_eq!(parse(b"\x00\x03S"), Err(MessageError::Length { kind: Kind::Start, found: 0 }));
    assert_eq!(parse(b"\x00\x06O\x01\xff\xfe"), Err(MessageError::NotText(Kind::SetupOutputs)));
    assert_eq!(parse(b"\x00\x06M\xc8ab"), Err(MessageError::Length { kind: Kind::Text, found: 3 }));
    let nan = ClientMessage::parse(Version::V2, package(b"\x00\x0cO\x7f\xf8\0\0\0\0\0\0a"));
    assert_eq!(nan, Err(MessageError::NotANumber(Kind::SetupOutputs)));
}

/// A server in memory, with inputs that another client may hold.
struct Server {
    version: Version,
    speaks: u16,
    unknown: &'static str,
    held: &'static str,
    outputs: Recipe<64>,
    inputs: Vec<Recipe<64>>,
    written: Vec<(u8, Vec<u8>)>,
}

impl Server {
    fn new(speaks: u16) -> Server {
        let (outputs, inputs, written) = (Recipe::new(), Vec::new(), Vec::new());
        Server { version: Version::V1, speaks, unknown: "", held: "", outputs, inputs, written }
    }

    fn types(&self, side: Side, list: &str) -> (String, Option<Recipe<64>>) {
        let words: Vec<Answer> = names(list)
            .map(|name| match Field::find(side, name) {
                Some(_) if name == self.unknown => Answer::NotFound,
                Some(_) if name == self.held => Answer::InUse,
                Some(field) => Answer::Type(field.kind()),
                None => Answer::NotFound,
            })
            .collect();
        let good = words.iter().all(|w| matches!(w, Answer::Type(_)));
        let mut out = vec![0u8; 4096];
        let list_of_types = join(words, &mut out).unwrap().to_owned();
        (list_of_types, good.then(|| Recipe::parse(side, list).unwrap()))
    }

    fn answer(&mut self, package: Package<'_>) -> Vec<u8> {
        let mut out = vec![0u8; 8192];
        let message = ClientMessage::parse(self.version, package).unwrap();
        let before = self.version;
        let n = match message {
            ClientMessage::RequestVersion(number) => {
                let yes = number <= self.speaks;
                if yes {
                    self.version = Version::from_number(number).unwrap();
                }
                ControllerMessage::VersionAccepted(yes).emit(before, &mut out)
            }
            ClientMessage::GetControllerVersion => {
                let v = ControllerVersion { major: 5, minor: 11, bugfix: 0, build: 1 };
                ControllerMessage::ControllerVersion(v).emit(before, &mut out)
            }
            ClientMessage::SetupOutputs { frequency_hz, names } => {
                assert_eq!(frequency_hz.is_some(), before == Version::V2);
                let (types, recipe) = self.types(Side::Output, names);
                self.outputs = recipe.unwrap_or_default();
                ControllerMessage::OutputsSetUp { recipe: Some(1), types: &types }.emit(before, &mut out)
            }
            ClientMessage::SetupInputs { names } => {
                let (types, recipe) = self.types(Side::Input, names);
                let id = recipe.map_or(0, |r| {
                    self.inputs.push(r);
                    self.inputs.len() as u8
                });
                ControllerMessage::InputsSetUp { recipe: id, types: &types }.emit(before, &mut out)
            }
            ClientMessage::Start => ControllerMessage::Started(true).emit(before, &mut out),
            ClientMessage::Pause => ControllerMessage::Paused(true).emit(before, &mut out),
            ClientMessage::Data { recipe, values } => {
                self.written.push((recipe, values.to_vec()));
                return Vec::new();
            }
            ClientMessage::Text(_) => return Vec::new(),
        };
        out.truncate(n.unwrap());
        out
    }
}

/// Runs the handshake until it is done, refused or stuck; bytes are passed in pieces of `piece` bytes.
fn meet(server: &mut Server, piece: usize) -> Result<Session, ClientError> {
    let mut session = Session::new(&STATE_FIELDS, &[&COMMAND_FIELDS], Some(500.0))?;
    let (mut to_server, mut to_client) = (Framer::new([0u8; 8192]), Framer::new([0u8; 8192]));
    let mut out = [0u8; 4096];
    for _ in 0..20 {
        let Some(n) = session.transmit(&mut out)? else { break };
        assert_eq!(session.transmit(&mut out), Ok(None), "nothing is said twice");
        for bytes in out[..n].chunks(piece) {
            to_server.feed(bytes);
            while let Some(p) = to_server.next().unwrap() {
                for bytes in server.answer(p).chunks(piece) {
                    to_client.feed(bytes);
                    while let Some(p) = to_client.next().unwrap() {
                        session.handle(p)?;
                    }
                }
            }
        }
    }
    Ok(session)
}

#[test]
fn client_and_server_meet_in_both_versions_and_any_pieces() {
    for (speaks, version, rate) in [(2, Version::V2, 500.0), (1, Version::V1, 500.0)] {
        for piece in [1, 2, 7, 4096] {
            let mut server = Server::new(speaks);
            let mut session = meet(&mut server, piece).unwrap();
            assert_eq!((session.phase(), session.version()), (Phase::Running, version));
            assert_eq!(session.frequency_hz(), rate);

            // State to the client.
            let reader = StateReader::new(session.outputs()).unwrap();
            let mut values = vec![0u8; server.outputs.size()];
            let q = server.outputs.slot::<[f64; 6]>("actual_q").unwrap();
            q.write(&mut values, [0.1, -0.2, 0.3, -0.4, 0.5, -0.6]).unwrap();
            server.outputs.slot("output_int_register_27").unwrap().write(&mut values, 77i32).unwrap();
            let mut out = [0u8; 1024];
            let n = ControllerMessage::Data { recipe: Some(1), values: &values }.emit(version, &mut out).unwrap();
            let Ok(Event::Data(got)) = session.handle(package(&out[..n])) else { panic!("no data") };
            let state = reader.read(got, 5).unwrap();
            assert_eq!((state.q[5], state.script_token, state.received_ns), (-0.6, 77, 5));
            assert_eq!(reader.read(&got[..got.len() - 1], 5), None);

            // Command to the server.
            let writer = CommandWriter::new(session.input(0).unwrap().0, 4242, 9.0);
            let command = ArmCommand { mode: ArmMode::Velocity, rates: [0.25; 6], heartbeat: 9, outputs: 0x1_0001 };
            let n = writer.write(&command, None, &mut out).unwrap();
            assert_eq!(n, CommandWriter::PACKAGE);
            server.answer(package(&out[..n]));
            let (id, bytes) = server.written.pop().unwrap();
            let recipe = &server.inputs[id as usize - 1];
            assert_eq!(bytes.len(), recipe.size());
            let int = |name| recipe.slot::<i32>(name).unwrap().read(&bytes).unwrap();
            let double = |name| recipe.slot::<f64>(name).unwrap().read(&bytes).unwrap();
            assert_eq!([int("input_int_register_24"), int("input_int_register_25")], [1, 9]);
            assert_eq!([int("input_int_register_26"), int("input_int_register_27")], [4242, 0x1_0001]);
            assert_eq!([double("input_double_register_29"), double("input_double_register_30")], [0.25, 9.0]);
        }
    }
}

#[test]
fn refusals_name_the_field() {
    let mut server = Server { held: "input_double_register_26", ..Server::new(2) };
    let field = Field::input("input_double_register_26").unwrap();
    let error = meet(&mut server, 64).unwrap_err();
    assert_eq!(error, ClientError::InUse(field));
    assert!(error.to_string().contains("input_double_register_26"));
    let mut server = Server { unknown: "target_speed_fraction", ..Server::new(2) };
    assert_eq!(
        meet(&mut server, 64).unwrap_err(),
        ClientError::NotFound(Field::output("target_speed_fraction").unwrap())
    );
    assert_eq!(meet(&mut Server::new(0), 64).unwrap_err(), ClientError::VersionRefused);
}

#[test]
fn values_that_are_not_finite_are_sent_as_a_stop() {
    let mut out = [0u8; CommandWriter::PACKAGE];
    let writer = CommandWriter::new(1, 5, 9.0);
    for (rates, targets) in [([f64::NAN; 6], None), ([0.1; 6], Some([f64::INFINITY; 6]))] {
        let command = ArmCommand { mode: ArmMode::Velocity, rates, heartbeat: 1, outputs: 0 };
        writer.write(&command, targets.as_ref(), &mut out).unwrap();
        assert_eq!(out[4..8], 2i32.to_be_bytes());
        let doubles = out[20..].as_chunks::<8>().0;
        assert!(doubles.iter().map(|b| f64::from_be_bytes(*b)).all(|v| v == 0.0 || v == 9.0));
    }
}

#[test]
fn gaps_are_counted_by_the_controllers_clock() {
    let mut meter = GapMeter::new(0.002);
    let steps = [100.0, 100.002, 100.0041, 100.010, 100.010, 99.0, f64::NAN].map(|t| meter.observe(t));
    use ClockStep::*;
    assert_eq!(steps, [First, Next, Next, Skipped(2), Same, Back, Back]);
    assert_eq!((meter.packages, meter.missing), (7, 2));
}

/// All results of a stream as text; the buffer is smaller than the largest package, so that refusals occur as well.
fn events(stream: &[u8], cuts: &[usize], version: Version) -> Vec<String> {
    let mut framer = Framer::new(vec![0u8; 600]);
    let mut out = Vec::new();
    let mut rest = stream;
    let mut cuts = cuts.iter().cycle();
    while !rest.is_empty() {
        let n = (*cuts.next().unwrap_or(&1)).clamp(1, rest.len());
        let taken = framer.feed(&rest[..n]);
        rest = &rest[taken..];
        loop {
            match framer.next() {
                Ok(Some(p)) => {
                    let (c, s) = (ControllerMessage::parse(version, p), ClientMessage::parse(version, p));
                    out.push(format!("{c:?} {s:?}"));
                }
                Ok(None) => break,
                Err(e) => {
                    out.push(format!("{e:?}"));
                    return out;
                }
            }
        }
    }
    out
}

/// Bytes that often look like packages, so that parsing gets beyond the header.
fn stream() -> impl Strategy<Value = Vec<u8>> {
    let kind = prop_oneof![proptest::sample::select(b"VvMUOISP".to_vec()), any::<u8>()];
    let body = prop_oneof![
        proptest::collection::vec(any::<u8>(), 0..40),
        "(timestamp,|actual_q,|DOUBLE,|NOT_FOUND|IN_USE,){0,6}".prop_map(String::into_bytes),
    ];
    let lie = prop_oneof![9 => Just(0i32), 1 => -4i32..700];
    let one = (kind, body, lie).prop_map(|(kind, body, lie)| {
        let size = (body.len() as i32 + 3 + lie).clamp(0, 0xffff) as u16;
        let [h, l] = size.to_be_bytes();
        [vec![h, l, kind], body].concat()
    });
    prop_oneof![
        4 => proptest::collection::vec(one, 0..8).prop_map(|v| v.concat()),
        1 => proptest::collection::vec(any::<u8>(), 0..300),
    ]
}

proptest! {
    #[test]
    fn splits_change_nothing(bytes in stream(), cuts in proptest::collection::vec(1usize..50, 1..6), v2: bool) {
        let version = if v2 { Version::V2 } else { Version::V1 };
        prop_assert_eq!(events(&bytes, &cuts, version), events(&bytes, &[4096], version));
        prop_assert_eq!(events(&bytes, &[1], version), events(&bytes, &[4096], version));
    }

    #[test]
    fn what_parses_is_emitted_to_the_same_bytes(bytes in stream()) {
        let mut framer = Framer::new(vec![0u8; 600]);
        framer.feed(&bytes);
        while let Ok(Some(p)) = framer.next() {
            let mut out = [0u8; 700];
            if let Ok(m) = ClientMessage::parse(Version::V2, p)
                && !matches!(m, ClientMessage::Text(t) if t.level == Level::Info)
            {
                let n = m.emit(Version::V2, &mut out).unwrap();
                prop_assert_eq!(&out[3..n], p.body);
            }
        }
    }

    #[test]
    fn a_session_never_panics_and_never_runs_by_itself(bytes in stream()) {
        let mut session = Session::new(&["timestamp", "actual_q"], &[&["input_int_register_24"]], None).unwrap();
        let mut framer = Framer::new(vec![0u8; 600]);
        let mut out = [0u8; 4096];
        framer.feed(&bytes);
        while let Ok(Some(p)) = framer.next() {
            session.transmit(&mut out).unwrap();
            if session.handle(p).is_err() {
                break;
            }
        }
        prop_assert!(session.phase() != Phase::Running || bytes.windows(3).any(|w| w == b"\x00\x04S"));
    }

    #[test]
    fn values_round_trip_in_any_type(bytes in proptest::collection::vec(any::<u8>(), 0..60)) {
        for kind in FieldType::ALL {
            match Value::decode(kind, &bytes) {
                None => prop_assert!(bytes.len() < kind.size()),
                Some(value) => {
                    let mut out = [0u8; 48];
                    prop_assert_eq!(value.encode(&mut out), Some(kind.size()));
                    prop_assert!(kind == FieldType::Bool || out[..kind.size()] == bytes[..kind.size()]);
                }
            }
        }
    }
}

/// Fast fuzz: `GRASPD_FUZZ_CASES` cases of mutated packages through every parser (default 20 000).
#[test]
fn fuzz_every_parser() {
    let cases: u64 = std::env::var("GRASPD_FUZZ_CASES").ok().and_then(|s| s.parse().ok()).unwrap_or(20_000);
    let mut seed = 0x243f_6a88_85a3_08d3u64;
    let mut random = move || {
        seed ^= seed << 13;
        seed ^= seed >> 7;
        seed ^= seed << 17;
        seed
    };
    let words: [&[u8]; 6] = [b"timestamp,", b"actual_q", b"NOT_FOUND,", b"DOUBLE", b"\xff\xfe", b",,,"];
    let (mut framer, mut out) = (Framer::new([0u8; 512]), [0u8; 4096]);
    let (mut packages, mut messages) = (0u64, 0u64);
    for _ in 0..cases {
        let mut bytes = [0u8; 96];
        let len = 3 + random() as usize % 90;
        for chunk in bytes.chunks_mut(8) {
            let r = random().to_be_bytes();
            chunk.copy_from_slice(&r[..chunk.len()]);
        }
        if !random().is_multiple_of(8) {
            bytes[..2].copy_from_slice(&(len as u16).to_be_bytes());
        }
        if !random().is_multiple_of(8) {
            bytes[2] = b"VvMUOISP"[random() as usize % 8];
        }
        if random().is_multiple_of(2) {
            let word = words[random() as usize % words.len()];
            let at = 3 + random() as usize % 12;
            bytes[at..at + word.len()].copy_from_slice(word);
        }
        let cut = random() as usize % len;
        framer.clear();
        let mut session = Session::new(&["timestamp"], &[], None).unwrap();
        for part in [&bytes[..cut], &bytes[cut..len]] {
            framer.feed(part);
            while let Ok(Some(p)) = framer.next() {
                packages += 1;
                for version in [Version::V1, Version::V2] {
                    if let Ok(m) = ClientMessage::parse(version, p) {
                        messages += 1;
                        m.emit(version, &mut out).unwrap();
                        if let ClientMessage::SetupInputs { names } = m {
                            let _ = Recipe::<16>::parse(Side::Input, names);
                        }
                    }
                    if let Ok(m) = ControllerMessage::parse(version, p) {
                        messages += 1;
                        m.emit(version, &mut out).unwrap();
                        if let ControllerMessage::OutputsSetUp { types, .. } = m {
                            let _ = answers(types).count();
                        }
                    }
                }
                session.transmit(&mut out).unwrap();
                let _ = session.handle(p);
            }
        }
    }
    println!("{cases} cases, {packages} packages, {messages} messages");
    assert!(packages > cases / 2 && messages > cases / 4, "the fuzz does not get behind the header");
}
