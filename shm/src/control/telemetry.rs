//! The telemetry topic.

use super::sample::{TELEMETRY_MAGIC, TELEMETRY_VERSION, TelemetrySample};
use super::verbs::ControlError;
use crate::ShmNode;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

/// Samples that a new reader gets from before it joined.
const HISTORY: usize = 1;
/// Samples that a slow reader may fall behind before it misses some.
const BUFFER: usize = 8;
/// Samples that a reader may hold.
const BORROWED: usize = 2;
/// One daemon, and its successor.
const PUBLISHERS: usize = 2;
/// Largest number of readers: console, recorder, metrics, command line tools.
const SUBSCRIBERS: usize = 16;

fn open(node: &ShmNode) -> Result<PortFactory<ipc::Service, TelemetrySample, ()>, ControlError> {
    let name = node.names().service("telemetry");
    let parsed = ServiceName::new(&name).map_err(|e| ControlError::open(&name, &e))?;
    node.node()
        .service_builder(&parsed)
        .publish_subscribe::<TelemetrySample>()
        .history_size(HISTORY)
        .subscriber_max_buffer_size(BUFFER)
        .subscriber_max_borrowed_samples(BORROWED)
        .max_publishers(PUBLISHERS)
        .max_subscribers(SUBSCRIBERS)
        .enable_safe_overflow(true)
        .open_or_create()
        .map_err(|e| ControlError::open(&name, &e))
}

/// Publishes telemetry. iceoryx2 allocates when it sends: never publish from a real-time thread.
#[derive(Debug)]
pub struct TelemetryPublisher {
    publisher: Publisher<ipc::Service, TelemetrySample, ()>,
    _service: PortFactory<ipc::Service, TelemetrySample, ()>,
}

impl TelemetryPublisher {
    /// Opens or creates the topic.
    ///
    /// # Errors
    /// The topic exists with another layout, or the shared memory cannot be used.
    pub fn new(node: &ShmNode) -> Result<Self, ControlError> {
        let service = open(node)?;
        let publisher = service.publisher_builder().create().map_err(|e| ControlError::open("telemetry", &e))?;
        Ok(Self { publisher, _service: service })
    }

    /// Publishes one sample.
    ///
    /// # Errors
    /// iceoryx2 cannot send; the next call may succeed.
    pub fn publish(&self, sample: &TelemetrySample) -> Result<(), ControlError> {
        let loan = self.publisher.loan_uninit().map_err(|e| ControlError::io("telemetry", &e))?;
        loan.write_payload(*sample).send().map_err(|e| ControlError::io("telemetry", &e))?;
        Ok(())
    }
}

/// Reads telemetry.
#[derive(Debug)]
pub struct TelemetrySubscriber {
    subscriber: Subscriber<ipc::Service, TelemetrySample, ()>,
    _service: PortFactory<ipc::Service, TelemetrySample, ()>,
}

impl TelemetrySubscriber {
    /// Opens or creates the topic.
    ///
    /// # Errors
    /// The topic exists with another layout, or the shared memory cannot be used.
    pub fn new(node: &ShmNode) -> Result<Self, ControlError> {
        let service = open(node)?;
        let subscriber = service.subscriber_builder().create().map_err(|e| ControlError::open("telemetry", &e))?;
        Ok(Self { subscriber, _service: service })
    }

    /// The oldest unread sample, if there is one.
    ///
    /// # Errors
    /// iceoryx2 cannot receive, or the sample has another layout version.
    pub fn next(&self) -> Result<Option<TelemetrySample>, ControlError> {
        let Some(sample) = self.subscriber.receive().map_err(|e| ControlError::io("telemetry", &e))? else {
            return Ok(None);
        };
        if sample.magic != TELEMETRY_MAGIC || sample.layout_version != TELEMETRY_VERSION {
            return Err(ControlError::Version {
                service: "telemetry",
                found: sample.layout_version,
                expected: TELEMETRY_VERSION,
            });
        }
        Ok(Some(*sample))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_md_documents_the_quality_of_service() {
        for row in [
            format!("| history / subscriber buffer / borrowed | {HISTORY} / {BUFFER} / {BORROWED} |"),
            format!("| publishers / subscribers | {PUBLISHERS} / {SUBSCRIBERS} ("),
        ] {
            assert!(include_str!("../../CONTROL.md").contains(&row), "{row}");
        }
    }
}
