//! The modes of the loop, and the table of transitions between them.

mod fault;
mod fault_text;
mod hold;
mod reject;

pub use fault::FaultCause;
pub use hold::HoldCause;
pub use reject::Reject;

/// A mode.
///
/// ```text
///            marks tracked,            set-point, arm                servo
///            robot ready                                    (probe first, <= 10 % speed)
///  ┌──────┐ ─────────────► ┌──────────┐ ─────────► ┌───────┐ ─────────► ┌──────────┐  error small   ┌───────────┐
///  │ Idle │                │ Tracking │            │ Armed │            │ Servoing │ ─────────────► │ Converged │
///  └──────┘ ◄───────────── └──────────┘ ◄───────── └───────┘            └──────────┘ ◄───────────── └───────────┘
///     ▲      marks lost,      ▲          disarm        ▲                      │    error grew            │
///     │      robot not ready  │                        │ hold (servo          │                          │
///     │                       │                        │ goes on)             ▼                          │
///     │                       │ stop request      ┌────┴─────────────────────────┐                       │
///     │ reset                 └───────────────────│ Stopping: bounded ramp, then │ ◄─────────────────────┘
///     │ (moves nothing)                           └──────────────────────────────┘
///  ┌──┴────┐                  fault, rates at zero      │
///  │ Fault │ ◄──────────────────────────────────────────┘  ◄── from Armed as well, where nothing moves
///  └───────┘   the first cause stays until reset
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Mode {
    /// Marks are not tracked or the robot is not ready; nothing may move.
    Idle,
    /// Marks are tracked and the robot is ready.
    Tracking,
    /// A set-point is accepted and the operator has armed; nothing moves yet.
    Armed,
    /// The law drives the arm.
    Servoing,
    /// The marks are on the set-point. The loop stays closed and holds them there, also while the valve is turned.
    Converged,
    /// The rates ramp down to zero.
    Stopping(After),
    /// Latched, with the first cause.
    Fault(Latched),
}

/// What follows a stop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum After {
    /// After an operator's stop: tracking, disarmed.
    Tracking,
    /// After a hold: still armed; `servo` continues.
    Armed(HoldCause),
    /// After a fault.
    Fault(Latched),
}

/// A fault's first cause.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Latched {
    /// The cause.
    pub cause: FaultCause,
    /// Time of detection, CLOCK_MONOTONIC ns.
    pub at_ns: u64,
}

/// A mode's name without its data, for telemetry and tables.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
#[allow(missing_docs)]
pub enum ModeName {
    Idle = 0,
    Tracking = 1,
    Armed = 2,
    Servoing = 3,
    Converged = 4,
    Stopping = 5,
    Fault = 6,
}

impl ModeName {
    /// The name in logs and console.
    pub const fn as_str(self) -> &'static str {
        match self {
            ModeName::Idle => "idle",
            ModeName::Tracking => "tracking",
            ModeName::Armed => "armed",
            ModeName::Servoing => "servoing",
            ModeName::Converged => "converged",
            ModeName::Stopping => "stopping",
            ModeName::Fault => "fault",
        }
    }
}

impl Mode {
    /// The name without the data.
    pub const fn name(&self) -> ModeName {
        match self {
            Mode::Idle => ModeName::Idle,
            Mode::Tracking => ModeName::Tracking,
            Mode::Armed => ModeName::Armed,
            Mode::Servoing => ModeName::Servoing,
            Mode::Converged => ModeName::Converged,
            Mode::Stopping(_) => ModeName::Stopping,
            Mode::Fault(_) => ModeName::Fault,
        }
    }

    /// Whether the law may drive the arm. In every other mode but `Stopping` the rates are zero.
    pub const fn drives(&self) -> bool {
        matches!(self, Mode::Servoing | Mode::Converged)
    }

    /// The latched fault, also while its stop ramp still runs.
    pub const fn fault(&self) -> Option<&Latched> {
        match self {
            Mode::Fault(l) | Mode::Stopping(After::Fault(l)) => Some(l),
            _ => None,
        }
    }
}

/// An event that may change the mode.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Event {
    /// Marks are tracked and the robot is ready.
    Ready,
    /// Marks are not tracked or the robot is not ready.
    NotReady,
    /// Operator: arm; `Err` with what is missing.
    Arm(Result<(), Reject>),
    /// Operator: disarm.
    Disarm,
    /// Operator: start the motion; `Err` with what is missing.
    Servo(Result<(), Reject>),
    /// Operator: stop. Never refused.
    Stop,
    /// Operator: clear the fault.
    Reset {
        /// Whether the cause is gone.
        cause_gone: bool,
    },
    /// The last leg has ended and the error is small.
    Reached,
    /// The error grew again.
    Receded,
    /// The rates are zero.
    AtRest,
    /// A cause for a stop after which the operator may continue.
    Hold(HoldCause),
    /// A cause for a stop that latches.
    Fault(FaultCause),
}

/// What the caller has to do after a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Action {
    /// Nothing.
    None,
    /// The mode changed; nothing else to do.
    Changed,
    /// The mode changed: begin the motion (the path starts where the gripper is).
    Begin,
    /// The mode changed: ramp down.
    RampDown,
    /// The request is refused; the mode has not changed.
    Refuse(Reject),
}

/// The next mode and the action, for every mode and every event.
///
/// Every pair is defined: one that no rule names leaves the mode unchanged, and refuses the event if it is a request.
pub const fn step(mode: Mode, event: Event, now_ns: u64) -> (Mode, Action) {
    use Mode::{Armed, Converged, Fault, Idle, Servoing, Stopping, Tracking};
    match (mode, event) {
        // A fault latches in every mode in which the arm is armed or driven. In the others, lost readiness has the same
        // effect.
        (Servoing | Converged, Event::Fault(cause)) => {
            (Stopping(After::Fault(Latched { cause, at_ns: now_ns })), Action::RampDown)
        }
        (Armed, Event::Fault(cause)) => (Fault(Latched { cause, at_ns: now_ns }), Action::Changed),
        (Stopping(After::Fault(_)), Event::Fault(_)) => (mode, Action::None),
        (Stopping(_), Event::Fault(cause)) => (Stopping(After::Fault(Latched { cause, at_ns: now_ns })), Action::None),
        (Idle | Tracking | Fault(_), Event::Fault(_)) => (mode, Action::None),

        (Servoing | Converged, Event::Hold(cause)) => (Stopping(After::Armed(cause)), Action::RampDown),
        (_, Event::Hold(_)) => (mode, Action::None),

        // A stop is never refused. After a hold it disarms; it does not clear a fault.
        (Servoing | Converged, Event::Stop) => (Stopping(After::Tracking), Action::RampDown),
        (Stopping(After::Armed(_)), Event::Stop) => (Stopping(After::Tracking), Action::None),
        (Armed, Event::Stop) => (Tracking, Action::Changed),
        (Idle | Tracking | Stopping(_) | Fault(_), Event::Stop) => (mode, Action::None),

        (Stopping(After::Tracking), Event::AtRest) => (Tracking, Action::Changed),
        (Stopping(After::Armed(_)), Event::AtRest) => (Armed, Action::Changed),
        (Stopping(After::Fault(latched)), Event::AtRest) => (Fault(latched), Action::Changed),
        (_, Event::AtRest) => (mode, Action::None),

        (Fault(_), Event::Reset { cause_gone: true }) => (Idle, Action::Changed),
        (Fault(_), Event::Reset { cause_gone: false }) => (mode, Action::Refuse(Reject::CausePresent)),
        (_, Event::Reset { .. }) => (mode, Action::Refuse(Reject::WrongMode)),

        (Idle, Event::Ready) => (Tracking, Action::Changed),
        // Armed stays armed while the marks are hidden; `servo` is refused until they are seen again.
        (Tracking, Event::NotReady) => (Idle, Action::Changed),
        (_, Event::Ready | Event::NotReady) => (mode, Action::None),

        (Tracking, Event::Arm(Ok(()))) => (Armed, Action::Changed),
        (Tracking, Event::Arm(Err(reject))) => (mode, Action::Refuse(reject)),
        (Idle, Event::Arm(Err(reject))) => (mode, Action::Refuse(reject)),
        (_, Event::Arm(_)) => (mode, Action::Refuse(Reject::WrongMode)),
        (Armed, Event::Disarm) => (Tracking, Action::Changed),
        (_, Event::Disarm) => (mode, Action::Refuse(Reject::WrongMode)),

        (Armed, Event::Servo(Ok(()))) => (Servoing, Action::Begin),
        (Armed, Event::Servo(Err(reject))) => (mode, Action::Refuse(reject)),
        (_, Event::Servo(_)) => (mode, Action::Refuse(Reject::WrongMode)),

        (Servoing, Event::Reached) => (Converged, Action::Changed),
        (Converged, Event::Receded) => (Servoing, Action::Changed),
        (_, Event::Reached | Event::Receded) => (mode, Action::None),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAUSE: FaultCause = FaultCause::LinkLost;
    const FIRST: Latched = Latched { cause: FaultCause::ProtectiveStop, at_ns: 7 };
    const MODES: [Mode; 9] = [
        Mode::Idle,
        Mode::Tracking,
        Mode::Armed,
        Mode::Servoing,
        Mode::Converged,
        Mode::Stopping(After::Tracking),
        Mode::Stopping(After::Armed(HoldCause::MarksLost)),
        Mode::Stopping(After::Fault(FIRST)),
        Mode::Fault(FIRST),
    ];
    const EVENTS: [Event; 15] = [
        Event::Ready,
        Event::NotReady,
        Event::Arm(Ok(())),
        Event::Arm(Err(Reject::NoMarks)),
        Event::Disarm,
        Event::Servo(Ok(())),
        Event::Servo(Err(Reject::NoMarks)),
        Event::Stop,
        Event::Reset { cause_gone: true },
        Event::Reset { cause_gone: false },
        Event::Reached,
        Event::Receded,
        Event::AtRest,
        Event::Hold(HoldCause::MarksLost),
        Event::Fault(CAUSE),
    ];

    /// The next mode of each pair, one letter each: Idle, Tracking, Armed, Servoing, Converged, Stopping (t, a, f by
    /// what follows), Fault; `.` unchanged, `x` refused. Columns as in `EVENTS`.
    const TABLE: [&str; 9] = [
        "T.xxxxx.xx.....", // Idle
        ".IAxxxx.xx.....", // Tracking
        "..xxTSxTxx....F", // Armed
        "..xxxxxtxxC..af", // Servoing
        "..xxxxxtxx.S.af", // Converged
        "..xxxxx.xx..T.f", // Stopping, then tracking
        "..xxxxxtxx..A.f", // Stopping, then armed
        "..xxxxx.xx..F..", // Stopping, then fault
        "..xxxxx.Ix.....", // Fault
    ];

    fn letter(m: &Mode) -> char {
        match m {
            Mode::Idle => 'I',
            Mode::Tracking => 'T',
            Mode::Armed => 'A',
            Mode::Servoing => 'S',
            Mode::Converged => 'C',
            Mode::Stopping(After::Tracking) => 't',
            Mode::Stopping(After::Armed(_)) => 'a',
            Mode::Stopping(After::Fault(_)) => 'f',
            Mode::Fault(_) => 'F',
        }
    }

    #[test]
    fn every_pair_of_mode_and_event_follows_the_table() {
        for (mode, row) in MODES.iter().zip(TABLE) {
            assert_eq!(row.len(), EVENTS.len(), "{mode:?}");
            for (event, want) in EVENTS.iter().zip(row.chars()) {
                let (next, action) = step(*mode, *event, 99);
                match want {
                    'x' => {
                        assert!(matches!(action, Action::Refuse(_)), "{mode:?} {event:?} {action:?}");
                        assert_eq!(next, *mode);
                    }
                    '.' => assert_eq!((next, action), (*mode, Action::None), "{mode:?} {event:?}"),
                    c => {
                        assert_eq!(letter(&next), c, "{mode:?} {event:?}");
                        assert!(!matches!(action, Action::Refuse(_)));
                        // Every start and every end of motion has its action.
                        assert_eq!(
                            matches!(action, Action::Begin),
                            next.drives() && !matches!(event, Event::Reached | Event::Receded)
                        );
                        let stops = mode.drives() && matches!(next, Mode::Stopping(_));
                        assert_eq!(matches!(action, Action::RampDown), stops, "{mode:?} {event:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn the_first_cause_stays_until_a_reset() {
        let mut mode = step(Mode::Servoing, Event::Fault(FaultCause::ProtectiveStop), 7).0;
        for (k, e) in EVENTS.iter().cycle().take(150).enumerate() {
            if matches!(e, Event::Reset { cause_gone: true }) {
                continue;
            }
            mode = step(mode, *e, 100 + k as u64).0;
            assert_eq!(mode.fault(), Some(&FIRST), "{e:?}");
        }
        assert_eq!(step(mode, Event::Reset { cause_gone: true }, 999).0, Mode::Idle);
    }

    #[test]
    fn motion_starts_only_by_arm_and_then_servo() {
        for mode in MODES {
            for event in EVENTS {
                let (next, _) = step(mode, event, 0);
                if next.drives() && !mode.drives() {
                    assert_eq!((mode, event), (Mode::Armed, Event::Servo(Ok(()))));
                }
                if next == Mode::Armed && mode != Mode::Armed {
                    let resumed = matches!(mode, Mode::Stopping(After::Armed(_)));
                    assert!(resumed || (mode, event) == (Mode::Tracking, Event::Arm(Ok(()))));
                }
            }
        }
    }
}
