//! The receiving side: newest frame wins, everything else is counted.

use super::check::{FramePolicy, REJECTS, Reject, StereoFrame, check};
use super::{MAX_SUBSCRIBERS, StereoHeader, TOPIC, qos};
use crate::{Ipc, ShmError, ShmNode};
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::sample::Sample;

/// Most samples looked at in one call: twice what the topic can hold for a reader, so that a flood cannot keep it busy.
const DRAIN_CAP: usize = 8;

/// Counters since the subscriber was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameStats {
    /// Samples taken out of shared memory.
    pub received: u64,
    /// Frames handed to the caller.
    pub delivered: u64,
    /// Good frames passed over because a newer one was there.
    pub superseded: u64,
    /// Frames that never arrived, by gaps in the sequence.
    pub missed: u64,
    /// Refused samples by kind, in the order of [`Reject::ALL`].
    pub rejected: [u64; REJECTS],
    /// How often another publisher took over.
    pub takeovers: u64,
    /// Failures of `receive()` itself.
    pub receive_errors: u64,
}

impl FrameStats {
    /// Sum of all refusals.
    pub fn rejected_total(&self) -> u64 {
        self.rejected.iter().sum()
    }

    /// Refusals of one kind.
    pub fn rejected_of(&self, kind: Reject) -> u64 {
        self.rejected[kind as usize]
    }
}

/// What changed about who publishes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SourceEvent {
    /// The first publisher was heard.
    First,
    /// The publisher had been silent for the policy's time and another one took its place: tracks must be acquired anew.
    TakenOver,
    /// A second publisher sends while the first one is alive; its frames are refused (H06).
    SecondPublisher,
}

/// Outcome of one look at the topic.
#[derive(Debug)]
pub struct Received<'a> {
    /// The newest good frame since the last look, if there was one.
    pub frame: Option<StereoFrame<'a>>,
    /// Frames lost or passed over between this one and the one delivered before it.
    pub skipped: u64,
    /// Samples refused in this look.
    pub rejected: u32,
    /// The kind of the last refusal in this look.
    pub last_reject: Option<Reject>,
    /// Change of publisher, if any.
    pub source: Option<SourceEvent>,
    /// The transport itself failed (peer's segment gone, out of borrows): counted, and the next look tries again.
    pub transport_error: bool,
}

/// Reads the cell's frame topic. No allocation in [`Self::newest`] except when a publisher comes or goes, when iceoryx2 maps or
/// unmaps its segment (tens of milliseconds with locked memory): which is why only the vision thread may call it.
///
/// Not `Send`: create it on the thread that reads.
#[derive(Debug)]
pub struct FrameSubscriber {
    subscriber: Subscriber<Ipc, [u8], StereoHeader>,
    policy: FramePolicy,
    stats: FrameStats,
    held: Option<Sample<Ipc, [u8], StereoHeader>>,
    /// Publisher in charge, and when it was last heard (good or bad).
    source: Option<u128>,
    heard_ns: u64,
    /// Sequence and stamps of the newest good frame of that publisher, and of the last one delivered.
    newest: Option<(u64, [u64; 2])>,
    delivered: Option<u64>,
}

impl FrameSubscriber {
    /// Joins the cell's frame topic.
    pub fn new(node: &ShmNode, policy: FramePolicy) -> Result<Self, ShmError> {
        let service = qos::service(node)?;
        let subscriber = service.subscriber_builder().create().map_err(|e| ShmError::Port {
            port: "subscriber",
            service: node.names().service(TOPIC),
            reason: format!("{e:?}"),
            limit: MAX_SUBSCRIBERS,
        })?;
        Ok(Self {
            subscriber,
            policy,
            stats: FrameStats::default(),
            held: None,
            source: None,
            heard_ns: 0,
            newest: None,
            delivered: None,
        })
    }

    /// Counters so far.
    pub fn stats(&self) -> &FrameStats {
        &self.stats
    }

    /// When anything, good or bad, last came from the publisher in charge (CLOCK_MONOTONIC ns); 0 before the first.
    ///
    /// A dead publisher is silent, not an error: age is the watchdog.
    pub fn heard_ns(&self) -> u64 {
        self.heard_ns
    }

    /// Takes everything that waits and keeps the newest good frame. `now_ns` is CLOCK_MONOTONIC.
    ///
    /// At most eight samples are looked at in one call; a frame returned earlier is given back first.
    pub fn newest(&mut self, now_ns: u64) -> Received<'_> {
        self.held = None;
        let mut out =
            Received { frame: None, skipped: 0, rejected: 0, last_reject: None, source: None, transport_error: false };
        for _ in 0..DRAIN_CAP {
            let sample = match self.subscriber.receive() {
                Ok(Some(s)) => s,
                Ok(None) => break,
                Err(_) => {
                    self.stats.receive_errors += 1;
                    out.transport_error = true;
                    break;
                }
            };
            self.stats.received += 1;
            match self.judge(&sample, now_ns, &mut out.source) {
                Ok(()) => {
                    if self.held.is_some() {
                        self.stats.superseded += 1;
                    }
                    self.held = Some(sample);
                }
                Err(reject) => {
                    self.stats.rejected[reject as usize] += 1;
                    out.rejected += 1;
                    out.last_reject = Some(reject);
                }
            }
        }
        if let Some(sample) = &self.held {
            // Checked once more on the way out: the payload stays writable for its publisher, the header copy does not.
            if let Ok(frame) = check(sample.user_header(), sample.payload(), &self.policy, now_ns) {
                let sequence = frame.sequence();
                out.skipped = self.delivered.map_or(0, |d| sequence.saturating_sub(d + 1));
                self.delivered = Some(sequence);
                self.stats.delivered += 1;
                out.frame = Some(frame);
            }
        }
        out
    }

    /// Decides on one sample and updates order, gaps and source.
    fn judge(
        &mut self,
        sample: &Sample<Ipc, [u8], StereoHeader>,
        now_ns: u64,
        event: &mut Option<SourceEvent>,
    ) -> Result<(), Reject> {
        let origin = sample.origin().value();
        match self.source {
            Some(s) if s == origin => self.heard_ns = now_ns,
            Some(_) if now_ns.saturating_sub(self.heard_ns) < self.policy.takeover_ns => {
                *event = Some(SourceEvent::SecondPublisher);
                return Err(Reject::Foreign);
            }
            other => {
                // Only a frame that passes every check makes its sender the publisher in charge.
                check(sample.user_header(), sample.payload(), &self.policy, now_ns)?;
                *event = Some(if other.is_some() { SourceEvent::TakenOver } else { SourceEvent::First });
                self.stats.takeovers += u64::from(other.is_some());
                self.source = Some(origin);
                self.heard_ns = now_ns;
                self.newest = None;
                self.delivered = None;
            }
        }
        let frame = check(sample.user_header(), sample.payload(), &self.policy, now_ns)?;
        let (sequence, stamps) = (frame.sequence(), frame.capture_ns());
        if let Some((last, last_stamps)) = self.newest {
            if sequence <= last {
                return Err(Reject::Sequence);
            }
            if stamps.iter().zip(&last_stamps).any(|(s, l)| s <= l) {
                return Err(Reject::Order);
            }
            self.stats.missed += sequence - last - 1;
        }
        self.newest = Some((sequence, stamps));
        Ok(())
    }
}
