//! The request service: a client sends verbs, the daemon answers with JSON.

use super::request::{
    ANSWER_MAX_BYTES, AnswerHeader, REQUEST_MAGIC, REQUEST_MAX_BYTES, REQUEST_VERSION, RequestHeader, Verb,
};
use crate::ShmNode;
use iceoryx2::active_request::ActiveRequest;
use iceoryx2::port::client::Client;
use iceoryx2::port::server::Server;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::PortFactory as _;
use iceoryx2::service::port_factory::request_response::PortFactory;
use std::time::{Duration, Instant};

/// One daemon.
const SERVERS: usize = 1;
/// Consoles and command line tools.
const CLIENTS: usize = 16;
/// A client sends the next request after the answer to the last one.
const ACTIVE_REQUESTS: usize = 1;
/// Answers that wait for a client.
const RESPONSES: usize = 2;

type Factory = PortFactory<ipc::Service, [u8], RequestHeader, [u8], AnswerHeader>;

/// An error of telemetry or requests.
#[derive(Debug, thiserror::Error)]
pub enum ControlError {
    /// A service could not be opened.
    #[error(
        "shared-memory service '{service}' cannot be opened ({cause}): a program of another version may be running in this cell, or the \
         shared-memory root may belong to another user"
    )]
    Open {
        /// The service.
        service: String,
        /// iceoryx2's reason.
        cause: String,
    },
    /// A send or receive failed.
    #[error("shared-memory service '{service}' failed ({cause})")]
    Io {
        /// The service.
        service: &'static str,
        /// iceoryx2's reason.
        cause: String,
    },
    /// The other process uses another layout version.
    #[error("service '{service}' has layout version {found}, this program has {expected}: run programs of one version")]
    Version {
        /// The service.
        service: &'static str,
        /// Version of the other process.
        found: u32,
        /// Version of this program.
        expected: u32,
    },
    /// No daemon answers.
    #[error("no daemon answers in this cell; start it with 'graspd run', or name its cell and shared-memory root")]
    NoDaemon,
    /// The payload is longer than the service carries.
    #[error("the request has {length} bytes of payload, the limit is {limit}")]
    TooLong {
        /// Its length, bytes.
        length: usize,
        /// The limit, bytes.
        limit: usize,
    },
}

impl ControlError {
    pub(super) fn open(service: &str, cause: &dyn std::fmt::Debug) -> Self {
        ControlError::Open { service: service.to_owned(), cause: format!("{cause:?}") }
    }

    pub(super) fn io(service: &'static str, cause: &dyn std::fmt::Debug) -> Self {
        ControlError::Io { service, cause: format!("{cause:?}") }
    }
}

fn open(node: &ShmNode) -> Result<Factory, ControlError> {
    let name = node.names().service("requests");
    let parsed = ServiceName::new(&name).map_err(|e| ControlError::open(&name, &e))?;
    node.node()
        .service_builder(&parsed)
        .request_response::<[u8], [u8]>()
        .request_user_header::<RequestHeader>()
        .response_user_header::<AnswerHeader>()
        .max_servers(SERVERS)
        .max_clients(CLIENTS)
        .max_active_requests_per_client(ACTIVE_REQUESTS)
        .max_response_buffer_size(RESPONSES)
        .open_or_create()
        .map_err(|e| ControlError::open(&name, &e))
}

/// An answer of the daemon.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Answer {
    /// Whether the request was accepted.
    pub accepted: bool,
    /// One JSON object.
    pub json: String,
}

/// A client of the daemon.
#[derive(Debug)]
pub struct RequestClient {
    client: Client<ipc::Service, [u8], RequestHeader, [u8], AnswerHeader>,
    service: Factory,
}

impl RequestClient {
    /// Opens or creates the service.
    ///
    /// # Errors
    /// The service exists with another layout, or the shared memory cannot be used.
    pub fn new(node: &ShmNode) -> Result<Self, ControlError> {
        let service = open(node)?;
        let client = service
            .client_builder()
            .initial_max_slice_len(REQUEST_MAX_BYTES)
            .create()
            .map_err(|e| ControlError::open("requests", &e))?;
        Ok(Self { client, service })
    }

    /// Sends one request and waits at most `timeout` for its answer.
    ///
    /// # Errors
    /// [`ControlError::NoDaemon`] when no answer came in time.
    pub fn ask(&self, verb: Verb, payload: &[u8], stamp_ns: u64, timeout: Duration) -> Result<Answer, ControlError> {
        if payload.len() > REQUEST_MAX_BYTES {
            return Err(ControlError::TooLong { length: payload.len(), limit: REQUEST_MAX_BYTES });
        }
        let until = Instant::now() + timeout;
        // iceoryx2 drops a request that finds no server, so wait for one before sending. A request is sent only once.
        while self.service.dynamic_config().number_of_servers() == 0 {
            if Instant::now() >= until {
                return Err(ControlError::NoDaemon);
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        let mut loan =
            self.client.loan_slice_uninit(payload.len().max(1)).map_err(|e| ControlError::io("requests", &e))?;
        *loan.user_header_mut() = RequestHeader {
            magic: REQUEST_MAGIC,
            layout_version: REQUEST_VERSION,
            verb: verb.number(),
            length: u32::try_from(payload.len()).unwrap_or(0),
            stamp_ns,
        };
        let filled = loan.write_from_fn(|i| payload.get(i).copied().unwrap_or(0));
        let pending = filled.send().map_err(|e| ControlError::io("requests", &e))?;
        loop {
            if let Some(answer) = pending.receive().map_err(|e| ControlError::io("requests", &e))? {
                let h = *answer.user_header();
                if h.magic != REQUEST_MAGIC || h.layout_version != REQUEST_VERSION {
                    return Err(ControlError::Version {
                        service: "requests",
                        found: h.layout_version,
                        expected: REQUEST_VERSION,
                    });
                }
                let n = (h.length as usize).min(answer.payload().len());
                let json = String::from_utf8_lossy(&answer.payload()[..n]).into_owned();
                return Ok(Answer { accepted: h.status == 0, json });
            }
            if Instant::now() >= until {
                return Err(ControlError::NoDaemon);
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

/// A request as the daemon receives it.
pub struct Request {
    /// The verb.
    pub verb: Verb,
    /// Time of the request as the client states it, CLOCK_MONOTONIC nanoseconds.
    pub stamp_ns: u64,
    /// Its payload.
    pub payload: Vec<u8>,
    active: ActiveRequest<ipc::Service, [u8], RequestHeader, [u8], AnswerHeader>,
}

impl std::fmt::Debug for Request {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Request").field("verb", &self.verb).field("bytes", &self.payload.len()).finish_non_exhaustive()
    }
}

impl Request {
    /// Answers with one JSON object. A client that has ended is not an error.
    pub fn answer(&self, accepted: bool, json: &str) {
        respond(&self.active, u32::from(!accepted), json);
    }
}

fn respond(active: &ActiveRequest<ipc::Service, [u8], RequestHeader, [u8], AnswerHeader>, status: u32, json: &str) {
    let bytes = json.as_bytes();
    let n = bytes.len().min(ANSWER_MAX_BYTES);
    let Ok(mut loan) = active.loan_slice_uninit(n.max(1)) else { return };
    *loan.user_header_mut() = AnswerHeader {
        magic: REQUEST_MAGIC,
        layout_version: REQUEST_VERSION,
        status,
        length: u32::try_from(n).unwrap_or(0),
    };
    // The client may have ended before the answer; then nobody waits for it.
    let _ = loan.write_from_fn(|i| bytes.get(i).copied().unwrap_or(b' ')).send();
}

/// The daemon's end of the request service.
#[derive(Debug)]
pub struct RequestServer {
    server: Server<ipc::Service, [u8], RequestHeader, [u8], AnswerHeader>,
    _service: Factory,
}

impl RequestServer {
    /// Opens or creates the service. A cell has one server.
    ///
    /// # Errors
    /// Another daemon serves this cell, or the shared memory cannot be used.
    pub fn new(node: &ShmNode) -> Result<Self, ControlError> {
        let service = open(node)?;
        let server = service
            .server_builder()
            .initial_max_slice_len(ANSWER_MAX_BYTES)
            .create()
            .map_err(|e| ControlError::open("requests (is a second daemon running in this cell?)", &e))?;
        Ok(Self { server, _service: service })
    }

    /// The next well-formed request. Malformed ones are answered with status 2 and not returned.
    ///
    /// # Errors
    /// iceoryx2 cannot receive.
    pub fn next(&self) -> Result<Option<Request>, ControlError> {
        while let Some(active) = self.server.receive().map_err(|e| ControlError::io("requests", &e))? {
            let h = *active.user_header();
            let length = h.length as usize;
            let verb = Verb::from_number(h.verb);
            let sound =
                h.magic == REQUEST_MAGIC && h.layout_version == REQUEST_VERSION && length <= active.payload().len();
            match (sound, verb) {
                (true, Some(verb)) => {
                    let payload = active.payload()[..length].to_vec();
                    return Ok(Some(Request { verb, stamp_ns: h.stamp_ns, payload, active }));
                }
                _ => respond(&active, 2, r#"{"accepted":false,"reason":"malformed request: see shm/CONTROL.md"}"#),
            }
        }
        Ok(None)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_md_documents_the_quality_of_service() {
        let document = include_str!("../../CONTROL.md").replace('\n', " ");
        let text = format!("{CLIENTS} clients, one active request per client, a response buffer of {RESPONSES}");
        assert!(document.contains(&text) && document.contains("One server") && (SERVERS, ACTIVE_REQUESTS) == (1, 1));
    }
}
