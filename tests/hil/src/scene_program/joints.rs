//! The arm's joint positions over time, received as a second, read-only RTDE client.

use graspd_rt::arm::Joints;
use graspd_rt::rtde::{Event, FieldSlot, Framer, Session};
use std::collections::VecDeque;
use std::io::{Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Samples kept: half a second at 500 Hz.
const MAX_SAMPLES: usize = 256;
/// Longest gap between two samples that is interpolated, ns; a longer one is treated as a hold.
const MAX_GAP_NS: u64 = 50_000_000;

/// One sample of the arm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Sample {
    /// Sampling time, CLOCK_MONOTONIC nanoseconds.
    pub(super) at_ns: u64,
    /// Measured joints, rad.
    pub(super) q: Joints,
    /// Digital outputs.
    pub(super) outputs: u64,
}

/// The latest samples.
#[derive(Debug, Default)]
struct History {
    samples: VecDeque<Sample>,
    connected: bool,
    received: u64,
}

/// Shared history of the arm.
#[derive(Clone, Debug)]
pub(super) struct Arm {
    history: Arc<Mutex<History>>,
}

pub(super) fn now_ns() -> u64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    t.tv_sec.unsigned_abs() * 1_000_000_000 + t.tv_nsec.unsigned_abs()
}

impl Arm {
    /// An arm at rest.
    pub(super) fn fixed(q: Joints) -> Self {
        let arm = Self { history: Arc::default() };
        arm.push(Sample { at_ns: 1, q, outputs: 0 });
        arm.lock().received = 0;
        arm
    }

    fn lock(&self) -> MutexGuard<'_, History> {
        self.history.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn push(&self, s: Sample) {
        let mut h = self.lock();
        if h.samples.len() == MAX_SAMPLES {
            h.samples.pop_front();
        }
        h.samples.push_back(s);
        h.received += 1;
    }

    /// Whether the controller is connected, and the number of packages received.
    pub(super) fn link(&self) -> (bool, u64) {
        let h = self.lock();
        (h.connected, h.received)
    }

    /// The newest sample.
    pub(super) fn newest(&self) -> Option<Sample> {
        self.lock().samples.back().copied()
    }

    /// Joint positions at a time: interpolated between two samples, constant before the first and after the last.
    pub(super) fn at(&self, t_ns: u64) -> Option<Sample> {
        let h = self.lock();
        let after = h.samples.partition_point(|s| s.at_ns <= t_ns);
        let (a, b) = (h.samples.get(after.saturating_sub(1))?, h.samples.get(after));
        let Some(b) = b.filter(|b| b.at_ns > a.at_ns && a.at_ns <= t_ns) else { return Some(*a) };
        if b.at_ns - a.at_ns > MAX_GAP_NS {
            return Some(*a);
        }
        let k = (t_ns - a.at_ns) as f64 / (b.at_ns - a.at_ns) as f64;
        let q = std::array::from_fn(|i| a.q[i] + k * (b.q[i] - a.q[i]));
        Some(Sample { at_ns: t_ns, q, outputs: a.outputs })
    }

    /// Follows a controller until `stop`. Reconnects after a loss; the images show the last joints meanwhile.
    pub(super) fn follow(&self, address: String, stop: Arc<AtomicBool>) {
        let arm = self.clone();
        std::thread::spawn(move || {
            crate::host::prefer_this_thread(crate::host::EXPOSURE_FIFO, -12);
            let mut last = String::new();
            while !stop.load(Ordering::Relaxed) {
                if let Err(e) = arm.session(&address, &stop) {
                    if e != last {
                        eprintln!("graspd-scene: no joint positions from {address}: {e}; retrying");
                        last = e;
                    }
                } else {
                    last.clear();
                }
                arm.lock().connected = false;
                std::thread::sleep(Duration::from_millis(200));
            }
        });
    }

    /// Runs one connection from the handshake to its end.
    fn session(&self, address: &str, stop: &AtomicBool) -> Result<(), String> {
        let text = |e: std::io::Error| e.to_string();
        let target = address.to_socket_addrs().map_err(text)?.next().ok_or("the address resolves to no host")?;
        let mut stream = TcpStream::connect_timeout(&target, Duration::from_secs(2)).map_err(text)?;
        stream.set_nodelay(true).map_err(text)?;
        stream.set_read_timeout(Some(Duration::from_millis(500))).map_err(text)?;
        stream.set_write_timeout(Some(Duration::from_millis(500))).map_err(text)?;
        let outputs = ["actual_q", "actual_digital_output_bits", "timestamp"];
        let mut session = Session::new(&outputs, &[], None).map_err(|e| e.to_string())?;
        let slots = session.outputs();
        let (Some(joints), Some(bits), Some(clock)) =
            (slots.slot::<Joints>(outputs[0]), slots.slot::<u64>(outputs[1]), slots.slot::<f64>(outputs[2]))
        else {
            return Err("actual_q is missing in the RTDE variable table".into());
        };
        let mut framer = Framer::new(vec![0u8; 1 << 16]);
        let mut out = [0u8; 4096];
        let mut silent = 0;
        let mut times = ClockMap::default();
        while !stop.load(Ordering::Relaxed) {
            while let Some(n) = session.transmit(&mut out).map_err(|e| e.to_string())? {
                stream.write_all(out.get(..n).unwrap_or_default()).map_err(text)?;
            }
            match stream.read(framer.space()) {
                Ok(0) => return Err("the controller closed the connection".into()),
                Ok(n) => {
                    framer.commit(n);
                    silent = 0;
                }
                Err(e) if matches!(e.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut) => {
                    silent += 1;
                    if silent > 4 {
                        return Err("the controller has sent nothing for 2 s".into());
                    }
                }
                Err(e) => return Err(e.to_string()),
            }
            let at_ns = now_ns();
            while let Some(package) = framer.next().map_err(|e| e.to_string())? {
                if let Event::Data(values) = session.handle(package).map_err(|e| e.to_string())? {
                    let taken = clock.read(values).map_or(at_ns, |stamp| times.on_host(stamp, at_ns));
                    self.take(joints, bits, values, taken);
                }
            }
        }
        Ok(())
    }

    fn take(&self, joints: FieldSlot<Joints>, bits: FieldSlot<u64>, values: &[u8], at_ns: u64) {
        let (Some(q), Some(outputs)) = (joints.read(values), bits.read(values)) else { return };
        if q.iter().all(|v| v.is_finite()) {
            self.push(Sample { at_ns, q, outputs });
            self.lock().connected = true;
        }
    }
}

/// Maps controller time to host time. A package can be late but never early, so the smallest recent delay is the offset
/// of the clocks.
///
/// "Recent" is 25 to 50 packages: longer than any delay of this program's reads, and short enough to follow a mock
/// whose clock lost time because the host stalled it.
#[derive(Debug, Default)]
struct ClockMap {
    /// Smallest host minus controller time, ns, in the present and in the previous window.
    smallest: [Option<f64>; 2],
    /// Packages in the present window.
    packages: u32,
}

impl ClockMap {
    /// Packages per window.
    const WINDOW: u32 = 25;

    /// Host time, ns, at which a package with this time stamp (s) was created, given the time of reading.
    fn on_host(&mut self, stamp_s: f64, read_ns: u64) -> u64 {
        let found = read_ns as f64 - stamp_s * 1e9;
        if !found.is_finite() {
            return read_ns;
        }
        if self.packages == Self::WINDOW {
            self.smallest = [None, self.smallest[0]];
            self.packages = 0;
        }
        self.packages += 1;
        self.smallest[0] = Some(self.smallest[0].map_or(found, |l| l.min(found)));
        let offset = self.smallest.into_iter().flatten().fold(f64::INFINITY, f64::min);
        // A delay above one second means that the controller's clock was set back: the windows are invalid.
        let delay = found - offset;
        if delay > 1e9 {
            *self = Self { smallest: [Some(found), None], packages: 1 };
            return read_ns;
        }
        read_ns.saturating_sub(delay as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_late_package_is_assigned_its_creation_time() {
        let mut clock = ClockMap::default();
        for k in 0..1000u64 {
            let made = 5_000_000_000 + 2_000_000 * k;
            // Batches up to 30 ms late, and a controller clock that loses 40 ms once.
            let made = if k < 500 { made } else { made + 40_000_000 };
            let late = if k % 50 < 15 { 2_000_000 * (15 - k % 50) } else { 50_000 };
            let at = clock.on_host(100.0 + 0.002 * k as f64, made + late);
            if k > 60 && !(500..560).contains(&k) {
                assert!(at.abs_diff(made + 50_000) < 20_000, "{k}: {at} for {made}");
            }
        }
        // A restarted controller counts from zero.
        assert_eq!(clock.on_host(0.0, 60_000_000_000), 60_000_000_000);
    }

    #[test]
    fn joints_are_interpolated_between_samples_and_constant_outside() {
        let arm = Arm { history: Arc::default() };
        assert_eq!(arm.at(5), None);
        for k in 0..400u64 {
            arm.push(Sample { at_ns: 1_000 + 2_000_000 * k, q: [k as f64; 6], outputs: k });
        }
        let h = |k: u64| 1_000 + 2_000_000 * k;
        assert_eq!(arm.at(h(300)).unwrap().q, [300.0; 6]);
        assert!((arm.at(h(300) + 500_000).unwrap().q[2] - 300.25).abs() < 1e-9);
        assert_eq!(arm.at(h(399) + 9_000_000).unwrap().q, [399.0; 6]);
        assert_eq!(arm.at(0).unwrap().q, [144.0; 6], "older than what is kept: the oldest");
        arm.push(Sample { at_ns: h(399) + 80_000_000, q: [0.0; 6], outputs: 0 });
        assert_eq!(arm.at(h(399) + 40_000_000).unwrap().q, [399.0; 6], "a gap is a hold");
    }
}
