//! Telemetry and requests between a daemon and its clients.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

mod common;

use common::{Place, now_ns};
use graspd_shm::control::*;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

#[test]
fn a_request_is_received_once_and_answered() {
    let place = Place::new();
    let server_node = place.node("daemon");
    let client_node = place.node("client");
    let done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let server = RequestServer::new(&server_node).unwrap();
            let mut received = Vec::new();
            while !done.load(Ordering::Relaxed) {
                if let Some(r) = server.next().unwrap() {
                    let accept = r.verb != Verb::Servo;
                    received.push((r.verb, r.payload.len()));
                    r.answer(accept, &format!("{{\"received\":{}}}", received.len()));
                }
                std::thread::sleep(Duration::from_millis(1));
            }
            assert_eq!(received, [(Verb::Status, 0), (Verb::Setpoint, 100_000), (Verb::Servo, 0)]);
        });
        let client = RequestClient::new(&client_node).unwrap();
        let ask = |verb, payload: &[u8]| client.ask(verb, payload, now_ns(), Duration::from_secs(5)).unwrap();
        assert_eq!(ask(Verb::Status, b""), Answer { accepted: true, json: "{\"received\":1}".into() });
        assert!(ask(Verb::Setpoint, &vec![b'x'; 100_000]).accepted);
        assert!(!ask(Verb::Servo, b"").accepted);
        let long = client.ask(Verb::Setpoint, &vec![0; REQUEST_MAX_BYTES + 1], now_ns(), Duration::from_secs(1));
        assert!(matches!(long, Err(ControlError::TooLong { .. })));
        done.store(true, Ordering::Relaxed);
    });
}

#[test]
fn without_a_daemon_the_client_times_out() {
    let place = Place::new();
    let node = place.node("client");
    let client = RequestClient::new(&node).unwrap();
    let started = std::time::Instant::now();
    let got = client.ask(Verb::Servo, b"", now_ns(), Duration::from_millis(200));
    assert!(matches!(got, Err(ControlError::NoDaemon)), "{got:?}");
    assert!(started.elapsed() < Duration::from_secs(5));
}

#[test]
fn a_second_daemon_in_one_cell_is_refused() {
    let place = Place::new();
    let (a, b) = (place.node("daemon"), place.node("daemon2"));
    let _first = RequestServer::new(&a).unwrap();
    assert!(matches!(RequestServer::new(&b), Err(ControlError::Open { .. })));
}

#[test]
fn telemetry_arrives_complete() {
    let place = Place::new();
    let (a, b) = (place.node("daemon"), place.node("console"));
    let publisher = TelemetryPublisher::new(&a).unwrap();
    let subscriber = TelemetrySubscriber::new(&b).unwrap();
    let mut sample = TelemetrySample { sequence: 9, state: 3, ..Default::default() };
    sample.set_cause(&"ä".repeat(300));
    publisher.publish(&sample).unwrap();
    let got = subscriber.next().unwrap().unwrap();
    assert_eq!((got.sequence, got.state), (9, 3));
    assert!(got.cause_text().starts_with("ää") && got.cause_text().len() < TELEMETRY_TEXT);
    assert!(subscriber.next().unwrap().is_none());
}
