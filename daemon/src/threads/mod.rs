//! The daemon's threads, and the mailboxes and queues between them.
//!
//! ```text
//!  camera ─► shm ─► vision (FIFO, lower) ─Mailbox<Vision>► command (FIFO, higher) ─► robot
//!               └─► acquire (ordinary) ─Mailbox<Seed>─┘ ▲        │        ▲
//!                                                joints└────────┘        │ requests, set-point, stop latch
//!                    telemetry (ordinary) ◄──ring of CycleReport──┘       │
//!                    service (ordinary): verbs, signals, supervision ────┘   link manager (ordinary): (re)connects
//! ```

mod acquire;
mod advice;
mod command;
mod cycle_report;
mod damage;
mod frame_refusal;
mod mailbox;
mod report;
mod sample;
mod service;
mod shared;
mod telemetry;
mod timing;
mod vision;

pub use acquire::{AcquireReport, run as run_acquire};
pub use command::CommandWorker;
pub use cycle_report::CycleReport;
pub use damage::run as run_damage;
pub use frame_refusal::FrameRefusal;
pub use mailbox::Mailbox;
pub use report::Report;
pub use sample::fault_number;
pub use service::{Service, ramp_limit};
pub use shared::{JointSample, Seed, Shared, VisionCounters};
pub use telemetry::run as run_telemetry;
pub use timing::Latency;
pub use vision::{VisionWorker, policy};
