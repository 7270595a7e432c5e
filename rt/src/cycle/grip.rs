//! What the gripper holds, by the outputs that the controller really has: a restart remembers nothing, the outputs do.

use super::settings::TaskSettings;

/// The gripper by its outputs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum Grip {
    /// No outputs are configured for it.
    #[default]
    None = 0,
    /// Its outputs are as opening sets them.
    Open = 1,
    /// Its outputs are as closing sets them.
    Closed = 2,
    /// Its outputs are as neither sets them, or nobody has seen them yet.
    Unknown = 3,
}

impl Grip {
    /// In words, as the status verb writes it.
    pub const fn as_str(self) -> &'static str {
        match self {
            Grip::None => "no outputs configured",
            Grip::Open => "open",
            Grip::Closed => "closed",
            Grip::Unknown => "unknown: its outputs are as neither opening nor closing sets them",
        }
    }
}

/// How long after a command the outputs may still show the one before, ns: the way to the script and back, at 125 Hz
/// three steps each.
const SETTLE_NS: u64 = 100_000_000;

/// What was told and what was seen.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Fingers {
    /// The command that stands, and until when the outputs are not believed against it.
    told: Option<(bool, u64)>,
    grip: Grip,
}

impl Fingers {
    pub(super) fn new(task: &TaskSettings) -> Self {
        Self { told: None, grip: if task.has_outputs() { Grip::Unknown } else { Grip::None } }
    }

    /// A command is on its way.
    pub(super) fn tell(&mut self, close: bool, now_ns: u64) {
        self.told = Some((close, now_ns.saturating_add(SETTLE_NS)));
        if self.grip != Grip::None {
            self.grip = if close { Grip::Closed } else { Grip::Open };
        }
    }

    /// The controller's outputs, as numbered by the script.
    pub(super) fn observe(&mut self, task: &TaskSettings, levels: u32, now_ns: u64) {
        if self.told.is_none_or(|(_, until)| now_ns >= until) {
            self.grip = task.grip(levels);
        }
    }

    pub(super) fn grip(&self) -> Grip {
        self.grip
    }

    /// Whether the arm would pull at what the gripper holds, as far as anybody knows. Without outputs only what was
    /// told counts.
    pub(super) fn may_hold(&self) -> bool {
        match self.grip {
            Grip::None => self.told.is_some_and(|(close, _)| close),
            Grip::Open => false,
            Grip::Closed | Grip::Unknown => true,
        }
    }
}

impl TaskSettings {
    /// Whether any output moves the gripper.
    pub fn has_outputs(&self) -> bool {
        (self.close_outputs | self.open_outputs) >> 16 != 0
    }

    /// The gripper by the controller's outputs. Where only one way is configured, everything else is the other way.
    pub fn grip(&self, levels: u32) -> Grip {
        let shows = |word: u32| (word >> 16 != 0).then_some((levels ^ word) & (word >> 16) == 0);
        match (shows(self.close_outputs), shows(self.open_outputs)) {
            (None, None) => Grip::None,
            (Some(closed), None) => [Grip::Open, Grip::Closed][usize::from(closed)],
            (None, Some(open)) => [Grip::Closed, Grip::Open][usize::from(open)],
            (Some(true), Some(false)) => Grip::Closed,
            (Some(false), Some(true)) => Grip::Open,
            _ => Grip::Unknown,
        }
    }
}

/// Whether closing and opening cannot be told apart by the outputs: no output that both set is set differently. Such a
/// gripper would be "opened" by what closes it, and nobody could read back what it holds. Words are mask and values, 16
/// bits each.
pub const fn same_words(close: u32, open: u32) -> bool {
    let both = close >> 16 & open >> 16;
    close >> 16 != 0 && open >> 16 != 0 && (close ^ open) & both == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Closing sets 0 and clears 9, opening the reverse: a valve with two coils.
    const BOTH: TaskSettings = task(0x0201_0001, 0x0201_0200);

    const fn task(close_outputs: u32, open_outputs: u32) -> TaskSettings {
        TaskSettings {
            close_outputs,
            open_outputs,
            grip_ns: 0,
            close_on_arrival: false,
            max_turn_rad: 1.6,
            speed_share: 0.5,
        }
    }

    #[test]
    fn outputs_are_read_back() {
        // Other outputs than the gripper's say nothing.
        for other in [0, 0xfe] {
            assert_eq!(BOTH.grip(0x001 | other), Grip::Closed);
            assert_eq!(BOTH.grip(0x200 | other), Grip::Open);
            assert_eq!(BOTH.grip(0x201 | other), Grip::Unknown);
            assert_eq!(BOTH.grip(other), Grip::Unknown);
        }
        assert_eq!(task(0x0001_0001, 0).grip(1), Grip::Closed);
        assert_eq!(task(0x0001_0001, 0).grip(0), Grip::Open);
        assert_eq!(task(0, 0x0001_0001).grip(1), Grip::Open);
        assert_eq!(task(0, 0x0001_0001).grip(0), Grip::Closed);
        assert_eq!(task(0, 0).grip(1), Grip::None);
    }

    #[test]
    fn what_nobody_has_seen_may_hold_and_a_command_is_believed_until_it_can_show() {
        let mut f = Fingers::new(&BOTH);
        assert!(f.may_hold(), "nothing seen yet");
        f.observe(&BOTH, 0x200, 5);
        assert!(!f.may_hold());
        f.tell(true, 10);
        f.observe(&BOTH, 0x200, 10 + SETTLE_NS - 1);
        assert!(f.may_hold(), "the outputs are still on their way");
        f.observe(&BOTH, 0x200, 10 + SETTLE_NS);
        assert!(!f.may_hold(), "they never changed: it is open");
        let mut f = Fingers::new(&task(0, 0));
        assert!(!f.may_hold());
        f.tell(true, 0);
        f.observe(&task(0, 0), 0, u64::MAX);
        assert!(f.may_hold() && f.grip() == Grip::None);
    }

    #[test]
    fn words_that_cannot_be_told_apart() {
        assert!(same_words(0x0001_0001, 0x0001_0001), "the same");
        assert!(same_words(0x0001_0001, 0x0002_0002), "each sets its own and none takes the other's back");
        assert!(!same_words(0x0001_0001, 0x0001_0000));
        assert!(!same_words(0x0003_0001, 0x0003_0002));
        assert!(!same_words(0x0001_0001, 0), "one way only");
    }
}
