//! The daemon's threads, and the slots between them.
//!
//! ```text
//!  camera ─► shm ─► vision (FIFO, lower) ──Slot<Vision>──► command (FIFO, higher) ─► robot
//!               └─► acquire (ordinary) ──Slot<Seed>──┘ ▲        │        ▲
//!                                                joints└────────┘        │ requests, set-point, stop latch
//!                    telemetry (ordinary) ◄──ring of CycleReport──┘       │
//!                    service (ordinary): verbs, signals, supervision ────┘   link manager (ordinary): connect, hand over, reconnect
//! ```

mod acquire;
mod advice;
mod command;
mod damage;
mod refusal;
mod report;
mod service;
mod shared;
mod slot;
mod telemetry;
mod timing;
mod vision;

pub use acquire::{AcquireReport, run as run_acquire};
pub use command::CommandWorker;
pub use damage::run as run_damage;
pub use refusal::Refusal;
pub use report::Report;
pub use service::{Service, ramp_limit};
pub use shared::{JointSample, Seed, Shared, VisionCounters};
pub use slot::Slot;
pub use telemetry::{CycleReport, fault_number, run as run_telemetry, why_words};
pub use timing::Latency;
pub use vision::{VisionWorker, policy};
