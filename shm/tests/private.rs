//! What another user could reach of the shared memory, and what its owner loses when files are taken away.
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
fn a_node_takes_the_private_segment() {
    let place = Place::new();
    let node = place.node("first");
    let _server = RequestServer::new(&node).unwrap();
    let all = segments(&place);
    assert!(all.len() >= 2, "{all:?}");
    for path in &all {
        let mode = std::fs::metadata(path).unwrap().permissions().mode() & 0o777;
        assert_eq!(mode & 0o077, 0, "{}: {mode:o}", path.display());
    }
    // It is the one that iceoryx2 counts in: there is one, and a second node counts on.
    assert_eq!(all.iter().filter(|p| p.extension().is_some_and(|e| e == "global_mgmt")).count(), 1, "{all:?}");
    let count = || std::fs::read(counter(&place)).unwrap()[8];
    let before = count();
    let _second = place.node("second");
    assert_eq!(count(), before + 1);
}

#[test]
fn a_segment_open_to_others_or_full_of_garbage_is_replaced() {
    let place = Place::new();
    drop(place.node("first"));
    let path = counter(&place);
    let set = |mode| std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
    let number = || std::fs::metadata(&path).unwrap().ino();
    let before = number();
    set(0o666);
    drop(place.node("second"));
    assert_ne!(number(), before, "who had the old one open has nothing");
    assert_eq!(std::fs::metadata(&path).unwrap().mode() & 0o777, 0o600);
    for garbage in [vec![0xa5u8; 16], vec![], vec![7; 5000]] {
        std::fs::write(&path, &garbage).unwrap();
        drop(place.node("third"));
        assert_eq!(std::fs::metadata(&path).unwrap().len(), 16);
    }
}

#[test]
fn what_is_deleted_cut_or_written_over_is_noticed_and_use_is_not() {
    for harm in ["nothing", "delete", "cut", "write", "service"] {
        let place = Place::new();
        let node = place.node("daemon");
        let server = RequestServer::new(&node).unwrap();
        let telemetry = TelemetryPublisher::new(&node).unwrap();
        let more = place.names.root().join("more");
        std::fs::write(&more, "1").unwrap();
        let vital = Vital::of(&node, &[more]);
        assert!(vital.count() >= 9, "{vital:?}");
        // Other programs come, ask and go.
        for _ in 0..3 {
            let guest = place.node("guest");
            let client = graspd_shm::control::RequestClient::new(&guest).unwrap();
            let asked = client.ask(graspd_shm::control::Verb::Status, b"", 0, Duration::from_millis(5));
            assert!(asked.is_err(), "nobody answers here");
            let _ = server.next().unwrap();
            telemetry.publish(&TelemetrySample::default()).unwrap();
        }
        // Many at once: they write into pages of the services that nobody has touched before.
        let guests: Vec<_> = (0..12).map(|_| place.node("guest")).collect();
        let clients: Vec<_> = guests.iter().map(|g| graspd_shm::control::RequestClient::new(g).unwrap()).collect();
        std::thread::sleep(Duration::from_millis(20));
        drop((clients, guests));
        node.clean_up();
        assert_eq!(vital.damage(), None, "{harm}");
        let victim = segments(&place).into_iter().find(|p| p.extension().is_some_and(|e| e == "dynamic")).unwrap();
        match harm {
            "delete" => std::fs::remove_file(&victim).unwrap(),
            "cut" => std::fs::File::options().write(true).open(&victim).unwrap().set_len(4096 * 8).unwrap(),
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
