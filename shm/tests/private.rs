//! Permissions of the shared memory, and detection of deleted or changed files.
#![allow(clippy::unwrap_used)]

mod common;

use common::{Place, until};
use graspd_shm::Vital;
use graspd_shm::control::{RequestServer, TelemetryPublisher, TelemetrySample};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::PathBuf;
use std::time::Duration;

fn segments(place: &Place) -> Vec<PathBuf> {
    let all = std::fs::read_dir("/dev/shm").unwrap().flatten().map(|e| e.path());
    all.filter(|p| p.file_name().unwrap().to_str().unwrap().starts_with(place.names.prefix())).collect()
}

fn counter(place: &Place) -> PathBuf {
    segments(place).into_iter().find(|p| p.extension().is_some_and(|e| e == "global_mgmt")).unwrap()
}

#[test]
fn a_node_uses_the_private_segment() {
    let place = Place::new();
    let node = place.node("first");
    let _server = RequestServer::new(&node).unwrap();
    let all = segments(&place);
    assert!(all.len() >= 2, "{all:?}");
    for path in &all {
        let mode = std::fs::metadata(path).unwrap().permissions().mode() & 0o777;
        assert_eq!(mode & 0o077, 0, "{}: {mode:o}", path.display());
    }
    // iceoryx2 uses this segment: there is only one, and a second node increments its counter.
    assert_eq!(all.iter().filter(|p| p.extension().is_some_and(|e| e == "global_mgmt")).count(), 1, "{all:?}");
    let count = || std::fs::read(counter(&place)).unwrap()[8];
    let before = count();
    let _second = place.node("second");
    assert_eq!(count(), before + 1);
}

#[test]
fn a_segment_open_to_others_or_with_garbage_is_replaced() {
    let place = Place::new();
    drop(place.node("first"));
    let path = counter(&place);
    let set = |mode| std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
    let inode = || std::fs::metadata(&path).unwrap().ino();
    let before = inode();
    set(0o666);
    drop(place.node("second"));
    assert_ne!(inode(), before, "a process that has the old one open must not share the new one");
    assert_eq!(std::fs::metadata(&path).unwrap().mode() & 0o777, 0o600);
    for garbage in [vec![0xa5u8; 16], vec![], vec![7; 5000]] {
        std::fs::write(&path, &garbage).unwrap();
        drop(place.node("third"));
        assert_eq!(std::fs::metadata(&path).unwrap().len(), 16);
    }
}

#[test]
fn deleted_truncated_and_overwritten_files_are_reported_and_normal_use_is_not() {
    for harm in ["nothing", "delete", "truncate", "write", "service"] {
        let place = Place::new();
        let node = place.node("daemon");
        let server = RequestServer::new(&node).unwrap();
        let telemetry = TelemetryPublisher::new(&node).unwrap();
        let more = place.names.root().join("more");
        std::fs::write(&more, "1").unwrap();
        let vital = Vital::of(&node, &[more]);
        assert!(vital.count() >= 9, "{vital:?}");
        // Other programs connect, send a request and end.
        for _ in 0..3 {
            let guest = place.node("guest");
            let client = graspd_shm::control::RequestClient::new(&guest).unwrap();
            let asked = client.ask(graspd_shm::control::Verb::Status, b"", 0, Duration::from_millis(5));
            assert!(asked.is_err(), "this test does not answer");
            let _ = server.next().unwrap();
            telemetry.publish(&TelemetrySample::default()).unwrap();
        }
        // Many at a time: they write to pages of the services that were never written before.
        let guests: Vec<_> = (0..12).map(|_| place.node("guest")).collect();
        let clients: Vec<_> = guests.iter().map(|g| graspd_shm::control::RequestClient::new(g).unwrap()).collect();
        std::thread::sleep(Duration::from_millis(20));
        drop((clients, guests));
        node.clean_up();
        assert_eq!(vital.damage(), None, "{harm}");
        let victim = segments(&place).into_iter().find(|p| p.extension().is_some_and(|e| e == "dynamic")).unwrap();
        match harm {
            "delete" => std::fs::remove_file(&victim).unwrap(),
            "truncate" => std::fs::File::options().write(true).open(&victim).unwrap().set_len(4096 * 8).unwrap(),
            "write" => std::fs::File::options()
                .write(true)
                .open(counter(&place))
                .map(|mut f| {
                    std::io::Write::write_all(&mut f, b"garbage").unwrap();
                })
                .unwrap(),
            "service" => {
                std::fs::read_dir(place.names.root().join("services")).unwrap().flatten().take(1).for_each(|e| {
                    std::fs::remove_file(e.path()).unwrap();
                })
            }
            _ => {}
        }
        let seen = until(Duration::from_millis(50), || vital.damage());
        assert_eq!(seen.is_some(), harm != "nothing", "{harm}: {seen:?}");
    }
}
