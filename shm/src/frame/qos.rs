//! The quality of service of the frame topic; every process that opens it must ask for the same (`LAYOUT.md`).

use super::{StereoHeader, TYPE_NAME};
use crate::{Ipc, ShmError, ShmNode};
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory as PubSubFactory;

/// Service name below the cell's name.
pub const TOPIC: &str = "frames/stereo";
/// One camera driver, and its successor: a restarted driver need not wait until its dead predecessor is cleaned up.
pub const MAX_PUBLISHERS: usize = 2;
/// Daemon, console, recorder, and one guest.
pub const MAX_SUBSCRIBERS: usize = 4;
/// Pairs that wait for a reader; a newer pair overwrites the oldest.
pub const SUBSCRIBER_BUFFER: usize = 2;
/// Samples that a reader may hold: while it takes all waiting pairs it holds two for a moment.
pub const SUBSCRIBER_BORROWED: usize = 2;
/// Processes that may open the topic at one time.
pub const MAX_NODES: usize = 16;

/// What a process must agree on to open the topic, as text for error messages.
pub fn expectation() -> String {
    format!(
        "user header '{TYPE_NAME}' of {} bytes, alignment {}; payload slice of u8, alignment 1; history 0, subscriber buffer \
         {SUBSCRIBER_BUFFER}, borrowed {SUBSCRIBER_BORROWED}, max publishers {MAX_PUBLISHERS}, max subscribers {MAX_SUBSCRIBERS}, \
         max nodes {MAX_NODES}, safe overflow on",
        size_of::<StereoHeader>(),
        align_of::<StereoHeader>(),
    )
}

/// Opens the cell's frame topic, or creates it if this process is the first.
///
/// The factory is `Send`: open it in `main`, create the port on the thread that uses it.
///
/// # Errors
/// The topic exists with another layout or quality of service, or cannot be created.
pub fn service(node: &ShmNode) -> Result<PubSubFactory<Ipc, [u8], StereoHeader>, ShmError> {
    let name = node.names().service(TOPIC);
    let fail = |reason: String| ShmError::Service { service: name.clone(), reason, expected: expectation() };
    let service_name = ServiceName::new(&name).map_err(|e| fail(format!("{e:?}")))?;
    // A peer that is creating or destroying the service is done within milliseconds; any other error is final.
    let mut last = String::new();
    for _ in 0..10 {
        let opened = node
            .node()
            .service_builder(&service_name)
            .publish_subscribe::<[u8]>()
            .user_header::<StereoHeader>()
            .history_size(0)
            .subscriber_max_buffer_size(SUBSCRIBER_BUFFER)
            .subscriber_max_borrowed_samples(SUBSCRIBER_BORROWED)
            .max_publishers(MAX_PUBLISHERS)
            .max_subscribers(MAX_SUBSCRIBERS)
            .max_nodes(MAX_NODES)
            .enable_safe_overflow(true)
            .open_or_create();
        match opened {
            Ok(s) => return Ok(s),
            Err(e) => {
                last = format!("{e:?}");
                let transient =
                    ["IsMarkedForDestruction", "IsBeingCreatedByAnotherInstance", "HangsInCreation", "SystemInFlux"];
                if !transient.iter().any(|p| last.contains(p)) {
                    break;
                }
                std::thread::sleep(std::time::Duration::from_millis(50));
            }
        }
    }
    Err(fail(last))
}
