//! Whether the gripper is closed, from the controller's outputs: they persist when the daemon restarts.

use super::settings::TaskSettings;

/// State of the gripper by its outputs.
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
    /// Its outputs are as neither sets them, or have not been read yet.
    Unknown = 3,
}

impl Grip {
    /// The text in the answer to `status`.
    pub const fn as_str(self) -> &'static str {
        match self {
            Grip::None => "no outputs configured",
            Grip::Open => "open",
            Grip::Closed => "closed",
            Grip::Unknown => "unknown: its outputs are as neither opening nor closing sets them",
        }
    }
}

/// Time after a command in which the outputs may still show the command before it, ns: three steps at 125 Hz to the
/// script, and three back.
const SETTLE_NS: u64 = 100_000_000;

/// The last command and the outputs that were read.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Fingers {
    /// The last command (`true` closes), and the time until which it counts more than the outputs, ns.
    commanded: Option<(bool, u64)>,
    grip: Grip,
}

impl Fingers {
    pub(super) fn new(task: &TaskSettings) -> Self {
        Self { commanded: None, grip: if task.has_outputs() { Grip::Unknown } else { Grip::None } }
    }

    /// Notes a command.
    pub(super) fn command(&mut self, close: bool, now_ns: u64) {
        self.commanded = Some((close, now_ns.saturating_add(SETTLE_NS)));
        if self.grip != Grip::None {
            self.grip = if close { Grip::Closed } else { Grip::Open };
        }
    }

    /// Takes the controller's outputs, numbered as by the script.
    pub(super) fn observe(&mut self, task: &TaskSettings, levels: u32, now_ns: u64) {
        if self.commanded.is_none_or(|(_, until)| now_ns >= until) {
            self.grip = task.grip(levels);
        }
    }

    pub(super) fn grip(&self) -> Grip {
        self.grip
    }

    /// Whether the gripper may hold something. Without configured outputs the last command decides.
    pub(super) fn may_hold(&self) -> bool {
        match self.grip {
            Grip::None => self.commanded.is_some_and(|(close, _)| close),
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

    /// State of the gripper from the controller's outputs. If outputs are configured for one direction only, any other
    /// value is the other direction.
    pub fn grip(&self, levels: u32) -> Grip {
        let matches = |word: u32| (word >> 16 != 0).then_some((levels ^ word) & (word >> 16) == 0);
        match (matches(self.close_outputs), matches(self.open_outputs)) {
            (None, None) => Grip::None,
            (Some(closed), None) => [Grip::Open, Grip::Closed][usize::from(closed)],
            (None, Some(open)) => [Grip::Closed, Grip::Open][usize::from(open)],
            (Some(true), Some(false)) => Grip::Closed,
            (Some(false), Some(true)) => Grip::Open,
            _ => Grip::Unknown,
        }
    }
}

/// Whether the outputs of closing and opening cannot be distinguished: no output that both set is set differently.
/// Opening would then not undo closing, and the state could not be read back. Mask and values, 16 bits each.
pub const fn same_words(close: u32, open: u32) -> bool {
    let both = close >> 16 & open >> 16;
    close >> 16 != 0 && open >> 16 != 0 && (close ^ open) & both == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Closing sets output 0 and clears 9, opening the reverse: a valve with two coils.
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
        // Other outputs do not matter.
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
    fn unread_outputs_may_hold_and_a_command_counts_until_the_outputs_can_show_it() {
        let mut f = Fingers::new(&BOTH);
        assert!(f.may_hold(), "outputs not read yet");
        f.observe(&BOTH, 0x200, 5);
        assert!(!f.may_hold());
        f.command(true, 10);
        f.observe(&BOTH, 0x200, 10 + SETTLE_NS - 1);
        assert!(f.may_hold(), "the outputs may still be old");
        f.observe(&BOTH, 0x200, 10 + SETTLE_NS);
        assert!(!f.may_hold(), "they did not change: it is open");
        let mut f = Fingers::new(&task(0, 0));
        assert!(!f.may_hold());
        f.command(true, 0);
        f.observe(&task(0, 0), 0, u64::MAX);
        assert!(f.may_hold() && f.grip() == Grip::None);
    }

    #[test]
    fn outputs_that_cannot_be_distinguished() {
        assert!(same_words(0x0001_0001, 0x0001_0001), "the same");
        assert!(same_words(0x0001_0001, 0x0002_0002), "each sets its own output, and neither clears the other's");
        assert!(!same_words(0x0001_0001, 0x0001_0000));
        assert!(!same_words(0x0003_0001, 0x0003_0002));
        assert!(!same_words(0x0001_0001, 0), "one direction only");
    }
}
