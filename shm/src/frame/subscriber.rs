//! The receiving side: takes the newest good pair and counts everything else.

use super::check::{FramePolicy, StereoSample, check};
use super::{FrameError, MAX_SUBSCRIBERS, StereoHeader, TOPIC, qos};
use crate::{Ipc, ShmError, ShmNode};
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::sample::Sample;

/// Most samples taken in one call: twice what the topic can hold for two publishers, so that a flood of samples cannot
/// keep the reader busy.
const DRAIN_CAP: usize = 8;

/// Counters since the subscriber was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameStats {
    /// Samples taken out of shared memory.
    pub received: u64,
    /// Frames handed to the caller.
    pub delivered: u64,
    /// Good frames skipped because a newer one was there.
    pub superseded: u64,
    /// Frames that never arrived, counted by gaps of the sequence number.
    pub missed: u64,
    /// Refused samples by kind, in the order of [`FrameError::ALL`].
    pub rejected: [u64; FrameError::COUNT],
    /// Number of times that another publisher took over.
    pub takeovers: u64,
    /// Failures of `receive()` itself.
    pub receive_errors: u64,
}

impl FrameStats {
    /// Refused samples of all kinds.
    pub fn rejected_total(&self) -> u64 {
        self.rejected.iter().sum()
    }

    /// Refused samples of one kind.
    pub fn rejected_of(&self, kind: FrameError) -> u64 {
        self.rejected[kind as usize]
    }
}

/// A change of the publisher.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SourceEvent {
    /// The first publisher has sent a good frame.
    First,
    /// The publisher was silent for [`FramePolicy::takeover_ns`] and another one took its place: the marks must be
    /// acquired again.
    TakenOver,
    /// A second publisher sends while the first one is alive; its frames are refused.
    SecondPublisher,
}

/// Result of [`FrameSubscriber::newest`].
#[derive(Debug)]
pub struct Received<'a> {
    /// The newest good frame since the last call, if there was one.
    pub frame: Option<StereoSample<'a>>,
    /// Frames lost or skipped between this one and the one delivered before it.
    pub skipped: u64,
    /// Samples refused in this call.
    pub rejected: u32,
    /// Why the last of them was refused.
    pub last_error: Option<FrameError>,
    /// Change of publisher, if any.
    pub source: Option<SourceEvent>,
    /// `receive()` failed (the peer's segment is gone, no borrow is left); counted, and the next call tries again.
    pub transport_error: bool,
}

/// Reads the cell's frame topic.
///
/// [`Self::newest`] does not allocate, except when a publisher comes or goes: iceoryx2 then maps or unmaps its segment,
/// which takes tens of milliseconds with locked memory. The command thread must therefore not call it.
///
/// Not `Send`: create it on the thread that reads.
#[derive(Debug)]
pub struct FrameSubscriber {
    subscriber: Subscriber<Ipc, [u8], StereoHeader>,
    policy: FramePolicy,
    stats: FrameStats,
    held: Option<Sample<Ipc, [u8], StereoHeader>>,
    /// The accepted publisher.
    source: Option<u128>,
    /// When it last sent a sample, good or bad.
    heard_ns: u64,
    /// Sequence number and stamps of its newest good frame.
    newest: Option<(u64, [u64; 2])>,
    /// Sequence number of the last frame delivered.
    delivered: Option<u64>,
}

impl FrameSubscriber {
    /// Joins the cell's frame topic.
    ///
    /// # Errors
    /// The topic exists with another layout, or has as many subscribers as it allows.
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

    /// When the accepted publisher last sent a sample, good or bad (CLOCK_MONOTONIC ns); 0 before the first.
    ///
    /// A dead publisher is silent and causes no error: watch this age.
    pub fn heard_ns(&self) -> u64 {
        self.heard_ns
    }

    /// Takes all waiting samples and keeps the newest good one. `now_ns` is CLOCK_MONOTONIC.
    ///
    /// Takes at most eight samples in one call. The frame returned before is released first.
    pub fn newest(&mut self, now_ns: u64) -> Received<'_> {
        self.held = None;
        let mut out =
            Received { frame: None, skipped: 0, rejected: 0, last_error: None, source: None, transport_error: false };
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
                Err(error) => {
                    self.stats.rejected[error as usize] += 1;
                    out.rejected += 1;
                    out.last_error = Some(error);
                }
            }
        }
        if let Some(sample) = &self.held {
            // Checked again here, because the publisher can still write to the sample: what is returned is a checked
            // copy of the header.
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

    /// Checks one sample and updates order, gaps and source.
    fn judge(
        &mut self,
        sample: &Sample<Ipc, [u8], StereoHeader>,
        now_ns: u64,
        event: &mut Option<SourceEvent>,
    ) -> Result<(), FrameError> {
        let origin = sample.origin().value();
        match self.source {
            Some(s) if s == origin => self.heard_ns = now_ns,
            Some(_) if now_ns.saturating_sub(self.heard_ns) < self.policy.takeover_ns => {
                *event = Some(SourceEvent::SecondPublisher);
                return Err(FrameError::Foreign);
            }
            other => {
                // Only a sample that passes every check makes its sender the accepted publisher.
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
                return Err(FrameError::Sequence);
            }
            if stamps.iter().zip(&last_stamps).any(|(s, l)| s <= l) {
                return Err(FrameError::Order);
            }
            self.stats.missed += sequence - last - 1;
        }
        self.newest = Some((sequence, stamps));
        Ok(())
    }
}
