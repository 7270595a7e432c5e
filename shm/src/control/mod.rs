//! Telemetry out of the daemon and requests into it (`CONTROL.md` has the same for other languages).

mod request;
mod sample;
mod telemetry;
mod verbs;

pub use request::{
    ANSWER_MAX_BYTES, AnswerHeader, REQUEST_MAGIC, REQUEST_MAX_BYTES, REQUEST_VERSION, RequestHeader, Verb,
};
pub use sample::{Percentiles, TELEMETRY_MAGIC, TELEMETRY_MARKS, TELEMETRY_TEXT, TELEMETRY_VERSION, TelemetrySample};
pub use telemetry::{TelemetryPublisher, TelemetrySubscriber};
pub use verbs::{Answer, ControlError, Request, RequestClient, RequestServer};
