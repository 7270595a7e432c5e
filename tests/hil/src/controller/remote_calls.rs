//! HTTP requests of remote procedure calls. No call blocks the control step.

use crate::urscript::Remote;
use std::collections::HashMap;
use std::io::{Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::sync::mpsc::{Receiver, TryRecvError, channel};
use std::time::Duration;

/// Calls under way at a time.
const MAX_CALLS: usize = 16;
/// Time after which an attempt to connect fails.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);
/// Time after which a server that sends nothing counts as failed.
const READ_TIMEOUT: Duration = Duration::from_secs(60);
/// Largest response.
const MAX_RESPONSE_BYTES: usize = 1 << 20;

type Response = Result<Vec<u8>, String>;

/// Remote calls of the running program by number.
#[derive(Default)]
pub(super) struct RemoteCalls {
    calls: HashMap<u32, Receiver<Response>>,
    next: u32,
}

impl RemoteCalls {
    /// Sends a POST request on a helper thread. Returns the number of the call.
    pub(super) fn begin(&mut self, url: &str, body: &str) -> Result<u32, String> {
        if self.calls.len() >= MAX_CALLS {
            return Err(format!("more than {MAX_CALLS} remote calls at a time"));
        }
        let (host, path) =
            split(url).ok_or_else(|| format!("'{url}' is not an URL of the form http://host:port/path"))?;
        let request = format!(
            "POST {path} HTTP/1.0\r\nHost: {host}\r\nContent-Type: text/xml\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{body}",
            body.len()
        );
        let (sender, receiver) = channel();
        let url = url.to_owned();
        std::thread::spawn(move || {
            let result = post(&host, &request).map_err(|e| format!("{url}: {e}"));
            // The program may have ended meanwhile.
            let _ = sender.send(result);
        });
        self.next = self.next.wrapping_add(1);
        self.calls.insert(self.next, receiver);
        Ok(self.next)
    }

    /// Progress of a call.
    pub(super) fn poll(&mut self, call: u32) -> Remote {
        let Some(receiver) = self.calls.get(&call) else { return Remote::Failed("no such call".to_owned()) };
        let result = match receiver.try_recv() {
            Err(TryRecvError::Empty) => return Remote::Pending,
            Err(TryRecvError::Disconnected) => Err("the call was lost".to_owned()),
            Ok(result) => result,
        };
        self.calls.remove(&call);
        match result {
            Ok(body) => Remote::Response(body),
            Err(reason) => Remote::Failed(reason),
        }
    }

    /// Forgets all calls.
    pub(super) fn clear(&mut self) {
        self.calls.clear();
    }
}

/// `host:port` and path of an URL.
fn split(url: &str) -> Option<(String, String)> {
    let rest = url.strip_prefix("http://")?;
    let (host, path) = rest.find('/').map_or((rest, "/"), |i| rest.split_at(i));
    if host.is_empty() || url.contains(|c: char| c.is_whitespace() || c.is_control()) {
        return None;
    }
    Some((if host.contains(':') { host.to_owned() } else { format!("{host}:80") }, path.to_owned()))
}

fn post(host: &str, request: &str) -> Response {
    let text = |e: std::io::Error| e.to_string();
    let address = host.to_socket_addrs().map_err(text)?.next().ok_or("the host has no address")?;
    let mut stream = TcpStream::connect_timeout(&address, CONNECT_TIMEOUT).map_err(text)?;
    stream.set_read_timeout(Some(READ_TIMEOUT)).map_err(text)?;
    stream.set_write_timeout(Some(CONNECT_TIMEOUT)).map_err(text)?;
    stream.write_all(request.as_bytes()).map_err(text)?;
    read_response(&mut stream)
}

/// Reads an HTTP response: `Content-Length` bytes of body, or all until the server closes the connection.
fn read_response(stream: &mut impl Read) -> Response {
    let mut response = Vec::new();
    let mut buffer = [0; 4096];
    loop {
        let n = stream.read(&mut buffer).map_err(|e| e.to_string())?;
        response.extend_from_slice(&buffer[..n]);
        if response.len() > MAX_RESPONSE_BYTES {
            return Err(format!("a response of more than {MAX_RESPONSE_BYTES} bytes"));
        }
        let Some(end) = response.windows(4).position(|w| w == b"\r\n\r\n") else {
            if n == 0 {
                return Err("the response has no HTTP header".to_owned());
            }
            continue;
        };
        let head = String::from_utf8_lossy(&response[..end]).to_ascii_lowercase();
        let length = head.lines().find_map(|l| l.strip_prefix("content-length:")?.trim().parse::<usize>().ok());
        let body = response.len() - end - 4;
        if n > 0 && length.is_none_or(|l| body < l) {
            continue;
        }
        let status = head.lines().next().unwrap_or("");
        if status.split(' ').nth(1) != Some("200") {
            return Err(format!("HTTP status '{status}'"));
        }
        let mut body = response.split_off(end + 4);
        body.truncate(length.unwrap_or(usize::MAX));
        return Ok(body);
    }
}

#[cfg(test)]
mod tests {
    use super::{read_response, split};

    #[test]
    fn urls_are_split_into_host_and_path() {
        assert_eq!(split("http://127.0.0.1:40405/RPC2"), Some(("127.0.0.1:40405".into(), "/RPC2".into())));
        assert_eq!(split("http://cam"), Some(("cam:80".into(), "/".into())));
        for bad in ["https://a/", "http://", "http:///x", "http://a b/", "http://a/\r\nX: y"] {
            assert_eq!(split(bad), None, "{bad}");
        }
    }

    #[test]
    fn a_response_ends_after_its_content_length_or_with_the_connection() {
        let read = |text: &str| read_response(&mut text.as_bytes());
        assert_eq!(read("HTTP/1.1 200 OK\r\nContent-Length: 3\r\n\r\nabcdef").unwrap(), b"abc");
        assert_eq!(read("HTTP/1.0 200 OK\r\n\r\nabc").unwrap(), b"abc");
        assert!(read("HTTP/1.0 404 Not Found\r\n\r\n").unwrap_err().contains("404"));
        assert!(read("HTTP/1.0 200 OK").is_err());
    }
}
