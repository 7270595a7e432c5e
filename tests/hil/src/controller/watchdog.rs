//! `rtde_set_watchdog`: pauses or stops the program if an RTDE input is not written often enough.

use crate::urscript::{HostError, WatchdogAction};
use graspd_rt::rtde::Field;

/// Watchdogs of the running program.
#[derive(Clone, Debug, Default)]
pub(super) struct Watchdogs(Vec<Watchdog>);

#[derive(Clone, Debug)]
struct Watchdog {
    input: Field,
    period_s: f64,
    action: WatchdogAction,
    fed_s: f64,
}

/// Watchdogs of one program.
const MAX_WATCHDOGS: usize = 64;

impl Watchdogs {
    /// Adds or replaces the watchdog of one input.
    pub(super) fn set(
        &mut self,
        input: &str,
        frequency: f64,
        action: WatchdogAction,
        now_s: f64,
    ) -> Result<(), HostError> {
        let Some(field) = Field::input(input) else {
            return Err(HostError::Refused(format!("rtde_set_watchdog: there is no RTDE input '{input}'")));
        };
        if !(frequency >= 0.0 && frequency.is_finite()) {
            return Err(HostError::Refused(format!("rtde_set_watchdog: {frequency} Hz is not a frequency")));
        }
        self.0.retain(|w| w.input != field);
        // A frequency of zero removes the watchdog.
        if frequency > 0.0 && self.0.len() < MAX_WATCHDOGS {
            self.0.push(Watchdog { input: field, period_s: 1.0 / frequency, action, fed_s: now_s });
        }
        Ok(())
    }

    /// Notes that a client wrote `input`.
    pub(super) fn feed_field(&mut self, input: Field, now_s: f64) {
        for w in &mut self.0 {
            if w.input == input {
                w.fed_s = now_s;
            }
        }
    }

    /// Restarts all watchdogs when a paused program resumes.
    pub(super) fn feed_all(&mut self, now_s: f64) {
        for w in &mut self.0 {
            w.fed_s = now_s;
        }
    }

    /// Removes all watchdogs; called when the program ends.
    pub(super) fn clear(&mut self) {
        self.0.clear();
    }

    /// Input and action of a watchdog whose input was not written in time.
    pub(super) fn expired(&self, now_s: f64) -> Option<(Field, WatchdogAction)> {
        self.0
            .iter()
            .find(|w| w.action != WatchdogAction::Ignore && now_s - w.fed_s > w.period_s + 1e-9)
            .map(|w| (w.input, w.action))
    }
}
