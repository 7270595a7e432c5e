//! The frame topic between a publisher and a subscriber: order, loss, false headers, restarts.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

mod common;

use common::{Place, now_ns, until};
use graspd_shm::frame::*;
use graspd_shm::{Names, create_node};
use std::time::Duration;

const W: u32 = 64;
const H: u32 = 32;

fn geometry() -> FrameGeometry {
    FrameGeometry::packed(W, H, PixelFormat::Mono8)
}

fn stamp() -> FrameStamp {
    let now = now_ns();
    FrameStamp { capture_ns: [now; 2], publish_ns: now, exposure_ns: 1000, gain_db: 0.0, trigger: 0, flags: 0 }
}

fn send(p: &mut FramePublisher, value: u8) -> u64 {
    let mut loan = p.loan().unwrap();
    let (l, r) = loan.images();
    l.fill(value);
    r.fill(value ^ 0xff);
    loan.send(&stamp()).unwrap()
}

#[test]
fn the_newest_pair_is_delivered_and_losses_are_counted() {
    let place = Place::new();
    let (a, b) = (place.node("publisher"), place.node("subscriber"));
    let mut p = FramePublisher::new(&a, geometry()).unwrap();
    let mut s = FrameSubscriber::new(&b, FramePolicy { size: Some((W, H)), ..Default::default() }).unwrap();
    assert!(s.newest(now_ns()).frame.is_none());

    send(&mut p, 7);
    let got = s.newest(now_ns());
    assert_eq!(got.source, Some(SourceEvent::First));
    let f = got.frame.unwrap();
    assert_eq!((f.sequence(), f.width(), f.height()), (1, W as usize, H as usize));
    assert!(f.mono8(0).unwrap().iter().all(|v| *v == 7) && f.mono8(1).unwrap().iter().all(|v| *v == 0xf8));

    // Seven more: the topic keeps two of them for a slow reader, which takes the last and counts the others.
    for k in 0..7 {
        send(&mut p, k);
    }
    let got = s.newest(now_ns());
    assert_eq!(got.skipped, 6);
    assert_eq!(got.frame.unwrap().sequence(), 8);
    assert_eq!((s.stats().missed, s.stats().superseded), (5, 1));

    // A pair that the driver lost is a gap as well.
    p.skip();
    send(&mut p, 1);
    let got = s.newest(now_ns());
    assert_eq!((got.skipped, got.frame.unwrap().header().dropped), (1, 1));
    assert_eq!(s.stats().rejected_total(), 0);
}

#[test]
fn every_false_header_is_refused_with_its_own_error() {
    let place = Place::new();
    let (a, b) = (place.node("publisher"), place.node("subscriber"));
    let mut p = FramePublisher::new(&a, geometry()).unwrap();
    p.identify([id_hash("L"), id_hash("R")], id_hash("cal"), ClockSource::Simulated);
    let policy = FramePolicy {
        size: Some((W, H)),
        cameras: [id_hash("L"), id_hash("R")],
        calibration: id_hash("cal"),
        ..Default::default()
    };
    let mut s = FrameSubscriber::new(&b, policy).unwrap();
    send(&mut p, 0);
    assert!(s.newest(now_ns()).frame.is_some());

    type Edit = fn(&mut StereoHeader);
    let edits: [(FrameError, Edit); 26] = [
        (FrameError::Magic, |h| h.magic ^= 1),
        (FrameError::Version, |h| h.layout_version = 2),
        (FrameError::HeaderSize, |h| h.header_size = 128),
        (FrameError::Torn, |h| h.sequence_end -= 1),
        (FrameError::Format, |h| h.pixel_format = 0),
        (FrameError::Format, |h| h.pixel_format = 99),
        (FrameError::Size, |h| h.width = 0),
        (FrameError::Size, |h| h.width = 1 << 31),
        (FrameError::Size, |h| h.height = u32::MAX),
        (FrameError::Size, |h| h.height -= 1),
        (FrameError::Stride, |h| h.stride = W - 1),
        (FrameError::Stride, |h| h.stride = u32::MAX),
        (FrameError::Bounds, |h| h.stride += 1),
        (FrameError::Bounds, |h| h.offset[1] += 1),
        (FrameError::Bounds, |h| h.offset[1] = u64::MAX - 5),
        (FrameError::Bounds, |h| h.size[0] = u64::MAX),
        (FrameError::Bounds, |h| h.size[1] = 10),
        (FrameError::Overlap, |h| h.offset[1] = 5),
        (FrameError::Incomplete, |h| h.flags = flags::INCOMPLETE_RIGHT),
        (FrameError::Future, |h| h.capture_ns[1] += 3_600_000_000_000),
        (FrameError::Future, |h| h.capture_ns[0] = 0),
        (FrameError::Stale, |h| h.capture_ns = h.capture_ns.map(|t| t - 1_500_000_000)),
        (FrameError::Skew, |h| h.capture_ns[0] -= 8_000_000),
        (FrameError::Sequence, |h| (h.sequence, h.sequence_end) = (1, 1)),
        (FrameError::Cameras, |h| h.camera_id.swap(0, 1)),
        (FrameError::Calibration, |h| h.calibration_id = id_hash("other")),
    ];
    let mut before = s.stats().rejected;
    for (k, (want, edit)) in edits.into_iter().enumerate() {
        p.loan().unwrap().send_with(&stamp(), edit).unwrap();
        let got = s.newest(now_ns());
        assert!(got.frame.is_none(), "edit {k}");
        assert_eq!(got.last_error, Some(want), "edit {k}");
        before[want as usize] += 1;
        assert_eq!(s.stats().rejected, before, "edit {k}");
    }
    // A stamp that repeats while the sequence number advances.
    let st = stamp();
    p.loan().unwrap().send(&st).unwrap();
    assert!(s.newest(now_ns()).frame.is_some());
    p.loan().unwrap().send(&st).unwrap();
    assert_eq!(s.newest(now_ns()).last_error, Some(FrameError::Order));
    // A good frame is still accepted afterwards.
    send(&mut p, 3);
    assert!(s.newest(now_ns()).frame.is_some());
}

#[test]
fn random_headers_never_read_beyond_the_payload() {
    use proptest::prelude::*;
    let header = proptest::collection::vec(any::<u64>(), 24);
    proptest!(ProptestConfig::with_cases(2000), |(words in header, keep in any::<u32>(), len in 0usize..5000)| {
        let payload = vec![0u8; len];
        // Some fields are valid and the others random, so that every check is reached.
        let small = |w: u64| (w % 80) as u32;
        let mut h = StereoHeader {
            sequence: words[0],
            sequence_end: if keep & 1 == 0 { words[0] } else { words[1] },
            width: if keep & 2 == 0 { small(words[2]) } else { words[2] as u32 },
            height: if keep & 4 == 0 { small(words[3]) } else { words[3] as u32 },
            stride: if keep & 8 == 0 { small(words[4]) } else { words[4] as u32 },
            pixel_format: if keep & 16 == 0 { small(words[5]) % 10 } else { words[5] as u32 },
            capture_ns: [1_000_000_000; 2],
            ..Default::default()
        };
        for e in 0..2 {
            h.offset[e] = if keep & (32 << e) == 0 { words[6 + e] % 4000 } else { words[6 + e] };
            h.size[e] = if keep & (128 << e) == 0 { words[8 + e] % 4000 } else { words[8 + e] };
        }
        if let Ok(f) = check(&h, &payload, &FramePolicy::default(), 1_000_000_000) {
            let need = f.stride() * (f.height() - 1) + f.format().row_bytes(f.width() as u32) as usize;
            let mut grey = vec![0; f.width() * f.height()];
            for e in 0..2 {
                prop_assert!(f.bytes(e).len() >= need);
                prop_assert!(f.write_mono8(e, &mut grey));
            }
        }
    });
}

#[test]
fn a_second_publisher_is_refused_while_the_first_lives_and_accepted_after() {
    let place = Place::new();
    let nodes = [place.node("one"), place.node("two"), place.node("subscriber")];
    let mut one = FramePublisher::new(&nodes[0], geometry()).unwrap();
    let mut two = FramePublisher::new(&nodes[1], geometry()).unwrap();
    let mut s = FrameSubscriber::new(&nodes[2], FramePolicy::default()).unwrap();
    send(&mut one, 1);
    assert_eq!(s.newest(now_ns()).source, Some(SourceEvent::First));
    send(&mut two, 2);
    let got = s.newest(now_ns());
    assert_eq!((got.source, got.last_error), (Some(SourceEvent::SecondPublisher), Some(FrameError::Foreign)));
    assert!(got.frame.is_none());
    send(&mut one, 3);
    assert_eq!(s.newest(now_ns()).frame.unwrap().bytes(0)[0], 3);
    // The first one is silent for 0.6 s (time is an argument); the next frame of the other takes over.
    drop(one);
    send(&mut two, 4);
    let got = s.newest(now_ns() + 600_000_000);
    assert_eq!(got.source, Some(SourceEvent::TakenOver));
    assert_eq!(got.frame.unwrap().bytes(0)[0], 4);
}

#[test]
fn another_layout_is_refused_with_what_was_expected() {
    use iceoryx2::prelude::*;
    let place = Place::new();
    let node = place.node("old");
    let _old = node
        .node()
        .service_builder(&ServiceName::new(&place.names.service(TOPIC)).unwrap())
        .publish_subscribe::<[u8]>()
        .create()
        .unwrap();
    let error = FrameSubscriber::new(&node, FramePolicy::default()).unwrap_err().to_string();
    for part in ["test/frames/stereo", TYPE_NAME, "192", "alignment 8", "IncompatibleTypes", "LAYOUT.md"] {
        assert!(error.contains(part), "{part} missing in: {error}");
    }
}

/// Not a test: the child process that the next test kills.
#[test]
#[ignore = "child process of the restart test"]
fn child_publisher() {
    let Ok(root) = std::env::var("GRASPD_TEST_ROOT") else { return };
    let names = Names::new(root, &std::env::var("GRASPD_TEST_PREFIX").unwrap(), "test").unwrap();
    let node = create_node(&names, "child").unwrap();
    let mut p = FramePublisher::new(&node, geometry()).unwrap();
    for k in 0..20_000u32 {
        let mut loan = p.loan().unwrap();
        let (l, _) = loan.images();
        l.fill(k as u8);
        loan.send(&stamp()).unwrap();
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn a_killed_publisher_is_silent_and_its_successor_is_accepted() {
    let place = Place::new();
    let node = place.node("subscriber");
    let mut s = FrameSubscriber::new(&node, FramePolicy { takeover_ns: 200_000_000, ..Default::default() }).unwrap();
    for round in 0..4 {
        let mut child = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "child_publisher", "--ignored", "--nocapture"])
            .env("GRASPD_TEST_ROOT", place.names.root())
            .env("GRASPD_TEST_PREFIX", place.names.prefix())
            .stdout(std::process::Stdio::null())
            .stderr(std::process::Stdio::null())
            .spawn()
            .unwrap();
        let mut frames = 0;
        let mut source = None;
        let came = until(Duration::from_secs(20), || {
            let got = s.newest(now_ns());
            source = source.or(got.source);
            frames += u32::from(got.frame.is_some());
            (frames >= 20).then_some(())
        });
        let _ = child.kill();
        let _ = child.wait();
        assert!(came.is_some(), "round {round}: no frames from the publisher");
        assert_eq!(source, Some(if round == 0 { SourceEvent::First } else { SourceEvent::TakenOver }));
        // What it had sent may still be read. Then there is silence, and no error.
        std::thread::sleep(Duration::from_millis(250));
        while s.newest(now_ns()).frame.is_some() {}
        let got = s.newest(now_ns());
        assert!(got.frame.is_none() && !got.transport_error);
        node.clean_up();
    }
    // No segments accumulate: at most that of the last child is left, in addition to the service's own.
    let data = std::fs::read_dir("/dev/shm")
        .unwrap()
        .flatten()
        .filter(|f| {
            let n = f.file_name().to_string_lossy().to_string();
            n.starts_with(place.names.prefix()) && n.ends_with(".data")
        })
        .count();
    assert!(data <= 1, "{data} data segments left");
}
