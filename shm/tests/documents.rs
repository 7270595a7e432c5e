//! LAYOUT.md, CONTROL.md and the Python driver agree with the code: offsets, types, names, codes, limits, defaults.
#![allow(clippy::unwrap_used)] // a test

use graspd_shm::control::{
    ANSWER_MAX_BYTES, AnswerHeader, Percentiles, REQUEST_MAGIC, REQUEST_MAX_BYTES, REQUEST_VERSION, RequestHeader,
    TELEMETRY_MAGIC, TELEMETRY_VERSION, TelemetrySample, Verb,
};
use graspd_shm::frame::{
    ClockSource, FramePolicy, LAYOUT_VERSION, MAGIC, MAX_NODES, MAX_PUBLISHERS, MAX_SUBSCRIBERS, PixelFormat,
    SUBSCRIBER_BORROWED, SUBSCRIBER_BUFFER, StereoHeader, TOPIC, TYPE_NAME, flags,
};
use graspd_shm::names::DEFAULT_CELL;

const LAYOUT: &str = include_str!("../LAYOUT.md");
const CONTROL: &str = include_str!("../CONTROL.md");
const PYTHON: &str = include_str!("../python/publish_stereo.py");

/// Cells of the rows of the first table below the header row that contains `header`.
fn table<'a>(document: &'a str, header: &str) -> Vec<Vec<&'a str>> {
    let start = document.find(header).unwrap_or_else(|| panic!("no table with the header {header}"));
    let rows = document[start..].lines().skip(2).take_while(|l| l.starts_with('|'));
    rows.map(|l| l.trim_matches('|').split('|').map(str::trim).collect()).collect()
}

/// The type as the documents write it.
trait Documented {
    fn name() -> String;
}

macro_rules! scalars {
    ($($t:ident),*) => { $(impl Documented for $t { fn name() -> String { stringify!($t).into() } })* };
}
scalars!(u8, u32, i32, u64, f32, f64);

impl Documented for Percentiles {
    fn name() -> String {
        "f32[4]".into()
    }
}

impl<T: Documented, const N: usize> Documented for [T; N] {
    fn name() -> String {
        let inner = T::name();
        let (scalar, rest) = inner.split_at(inner.find('[').unwrap_or(inner.len()));
        format!("{scalar}[{N}]{rest}")
    }
}

fn type_of<S, T: Documented>(_: impl Fn(&S) -> &T) -> String {
    T::name()
}

/// Offset, type and name of each field of a structure, in order.
macro_rules! fields {
    ($s:ident: $($f:ident),* $(,)?) => {{
        // A pattern without `..` fails to compile when a field is missing here.
        let _complete = |s: $s| { let $s { $($f: _),* } = s; };
        [$((std::mem::offset_of!($s, $f), type_of(|s: &$s| &s.$f), stringify!($f))),*]
    }};
}

fn assert_fields(document: &str, header: &str, fields: &[(usize, String, &str)]) {
    let rows = table(document, header);
    assert_eq!(rows.len(), fields.len(), "{header}");
    for (row, (offset, kind, name)) in rows.iter().zip(fields) {
        assert_eq!(row[..3], [&*offset.to_string(), kind, &*format!("`{name}`")], "{header}");
    }
}

fn assert_row(document: &str, key: &str, value: impl std::fmt::Display) {
    let row = format!("| {key} | {value}");
    let at = document.find(&row).unwrap_or_else(|| panic!("the document has no row that begins with: {row}"));
    let next = document[at + row.len()..].chars().next();
    assert!(next.is_some_and(|c| !c.is_alphanumeric()), "{row} is followed by {next:?}");
}

#[test]
fn layout_documents_the_stereo_header() {
    let fields = fields!(StereoHeader:
        magic, layout_version, header_size, sequence, trigger, capture_ns, publish_ns, exposure_ns, gain_db, width,
        height, stride, pixel_format, offset, size, clock_source, flags, camera_id, calibration_id, dropped,
        sequence_end, reserved,
    );
    assert_fields(LAYOUT, "| offset | type | field | meaning |", &fields);
    assert!(LAYOUT.contains(&format!("`GRASPDST` ({MAGIC:#x} as a little-endian number)")));
    assert!(LAYOUT.contains(&format!("`layout_version` | {LAYOUT_VERSION} |")));
    assert!(LAYOUT.contains(&format!("`header_size` | {} |", size_of::<StereoHeader>())));
    let (size, alignment) = (size_of::<StereoHeader>(), align_of::<StereoHeader>());
    assert_row(LAYOUT, "user header type name", format_args!("`{TYPE_NAME}`, size {size}, alignment {alignment}"));
}

#[test]
fn layout_documents_the_quality_of_service() {
    for (key, value) in [
        ("max publishers", MAX_PUBLISHERS),
        ("max subscribers", MAX_SUBSCRIBERS),
        ("max nodes", MAX_NODES),
        ("history size", 0),
        ("subscriber max buffer size", SUBSCRIBER_BUFFER),
        ("subscriber max borrowed samples", SUBSCRIBER_BORROWED),
    ] {
        assert_row(LAYOUT, key, value);
    }
    // `qos::service` sets the history to 0 without a constant; `expectation` states what it asks for.
    assert!(graspd_shm::frame::expectation().contains("history 0"));
}

#[test]
fn layout_documents_codes_and_flags() {
    let documented: Vec<u32> = table(LAYOUT, "| code | name |")
        .iter()
        .flat_map(|row| row[0].split(',').map(|c| c.trim().parse::<u32>().unwrap()))
        .collect();
    assert_eq!(documented, PixelFormat::ALL.map(|f| f as u32));
    for row in table(LAYOUT, "| code | name |") {
        let format = PixelFormat::from_code(row[0].split(',').next().unwrap().parse().unwrap()).unwrap();
        let bytes = |w: u64| match row[2] {
            "w" => w,
            "2 w" => 2 * w,
            "ceil(3 w / 2)" => (3 * w).div_ceil(2),
            other => panic!("{other}"),
        };
        assert!([1, 2, 7, 1280].iter().all(|w| format.row_bytes(*w) == bytes(u64::from(*w))), "{format:?}");
    }
    let clock = [
        (ClockSource::Host, "host"),
        (ClockSource::Device, "device clock mapped to monotonic"),
        (ClockSource::Ptp, "PTP mapped to monotonic"),
        (ClockSource::Simulated, "simulated"),
    ];
    let clock = clock.map(|(code, name)| format!("{} {name}", code as u32)).join(", ");
    assert!(LAYOUT.contains(&clock), "{clock}");
    let bits = [
        (flags::INCOMPLETE_LEFT, "left incomplete"),
        (flags::INCOMPLETE_RIGHT, "right incomplete"),
        (flags::OVERRUN, "pairs dropped before this one"),
        (flags::SYNCHRONISED, "cameras synchronised"),
    ];
    let bits = bits.map(|(bit, name)| format!("{bit} {name}")).join(", ");
    assert!(LAYOUT.contains(&bits), "{bits}");
}

#[test]
fn layout_documents_the_limits_of_the_stamps() {
    let p = FramePolicy::default();
    let rules = LAYOUT[LAYOUT.find("## Rules").unwrap()..].replace('\n', " ");
    let rules = rules.split_whitespace().collect::<Vec<_>>().join(" ");
    for text in [
        format!(
            "more than {} ms in the future or older than {} s is refused",
            p.max_future_ns / 1_000_000,
            p.max_age_ns / 1_000_000_000
        ),
        format!("differ by more than {} ms is refused", p.max_skew_ns / 1_000_000),
        format!("silent for {} s", p.takeover_ns as f64 * 1e-9),
    ] {
        assert!(rules.contains(&text), "LAYOUT.md's rules lack: {text}");
    }
}

#[test]
fn documents_and_driver_use_the_names_of_the_code() {
    assert_row(LAYOUT, "service name", format_args!("`<cell>/{TOPIC}`"));
    assert!(LAYOUT.contains(&format!("by default `{DEFAULT_CELL}` |")));
    assert!(CONTROL.contains(&format!("by default `{DEFAULT_CELL}`:")));
    assert!(LAYOUT.contains("`graspd<uid>_`") && LAYOUT.contains("`/tmp/graspd-<uid>`"));
    let prefix = graspd_shm::Names::default_prefix();
    assert!(prefix.starts_with("graspd") && prefix.ends_with('_'));
    for text in [
        format!("\"--cell\", default=\"{DEFAULT_CELL}\""),
        format!("/{TOPIC}\""),
        format!("return \"{TYPE_NAME}\""),
        format!("max_publishers({MAX_PUBLISHERS})"),
        format!("max_subscribers({MAX_SUBSCRIBERS})"),
        format!("max_nodes({MAX_NODES})"),
        format!("subscriber_max_buffer_size({SUBSCRIBER_BUFFER})"),
        format!("subscriber_max_borrowed_samples({SUBSCRIBER_BORROWED})"),
        "history_size(0)".to_owned(),
    ] {
        assert!(PYTHON.contains(&text), "publish_stereo.py lacks: {text}");
    }
}

#[test]
fn control_documents_the_telemetry_sample() {
    let fields = fields!(TelemetrySample:
        magic, layout_version, sequence, stamp_ns, state, fault, phase, views, ticks, overruns, frames,
        frames_skipped, frames_refused, setpoint, link, robot_mode, safety_bits, limits_active, q, qd, command,
        screw, left_from_gripper, error_px, residual_px, distance_m, angle_rad, condition, gain, mark_count,
        marks_seen, log_lost, marks, goals, wakeup_us, compute_us, frame_to_command_us, round_trip_us, cause,
    );
    assert_fields(CONTROL, "| offset | type | field | unit, meaning |", &fields);
    let (size, alignment) = (size_of::<TelemetrySample>(), align_of::<TelemetrySample>());
    assert!(CONTROL.contains(&format!("size {size}, alignment {alignment} |")));
    assert!(CONTROL.contains(&format!("`layout_version` | {TELEMETRY_VERSION}; refuse any other")));
    assert_eq!(TELEMETRY_MAGIC.to_le_bytes(), *b"GTEL");
    // No padding hides behind a field: each begins where the one before it ends.
    let width = |kind: &str| {
        let (scalar, rest) = kind.split_at(kind.find('[').unwrap_or(kind.len()));
        let bytes = scalar[1..].parse::<usize>().unwrap() / 8;
        rest.split(['[', ']']).filter_map(|n| n.parse::<usize>().ok()).product::<usize>() * bytes
    };
    let end = fields.iter().fold(0, |at, (offset, kind, name)| {
        assert_eq!(at, *offset, "padding before {name}");
        at + width(kind)
    });
    assert_eq!(end, size);
}

#[test]
fn control_documents_the_requests() {
    let request = fields!(RequestHeader: magic, layout_version, verb, length, stamp_ns);
    assert_fields(CONTROL, "| offset | type | `GraspdRequestHeader` |", &request);
    let answer = fields!(AnswerHeader: magic, layout_version, status, length);
    assert_fields(CONTROL, "| offset | type | `GraspdAnswerHeader` |", &answer);
    assert_eq!(REQUEST_MAGIC.to_le_bytes(), *b"GREQ");
    assert_eq!(CONTROL.matches(&format!("`layout_version` | {REQUEST_VERSION} |")).count(), 2);
    let limits = format!("at most {REQUEST_MAX_BYTES} bytes in a request, {ANSWER_MAX_BYTES} in an answer");
    assert!(CONTROL.contains(&limits), "{limits}");
    let verbs = table(CONTROL, "| verb | name |");
    for row in &verbs {
        let verb = Verb::from_number(row[0].parse().unwrap()).unwrap_or_else(|| panic!("no verb {}", row[0]));
        assert_eq!(format!("{verb:?}").to_lowercase(), row[1].replace('-', ""));
    }
    assert_eq!(verbs.len(), (0..1000).filter(|n| Verb::from_number(*n).is_some()).count());
}
