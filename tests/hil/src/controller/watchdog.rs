//! `rtde_set_watchdog`: an input that must be written often enough, or the program pauses or stops.

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

/// More than a script would ever set.
const MOST: usize = 64;

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
        // A frequency of zero takes the watchdog away.
        if frequency > 0.0 && self.0.len() < MOST {
            self.0.push(Watchdog { input: field, period_s: 1.0 / frequency, action, fed_s: now_s });
        }
        Ok(())
    }

    /// Some client wrote `input`.
    pub(super) fn feed_field(&mut self, input: Field, now_s: f64) {
        for w in &mut self.0 {
            if w.input == input {
                w.fed_s = now_s;
            }
        }
    }

    /// A paused program goes on: every watchdog starts afresh.
    pub(super) fn feed_all(&mut self, now_s: f64) {
        for w in &mut self.0 {
            w.fed_s = now_s;
        }
    }

    /// All go away when the program stops.
    pub(super) fn clear(&mut self) {
        self.0.clear();
    }

    /// The input and the action of a watchdog that has not been fed in time.
    pub(super) fn expired(&self, now_s: f64) -> Option<(Field, WatchdogAction)> {
        self.0
            .iter()
            .find(|w| w.action != WatchdogAction::Ignore && now_s - w.fed_s > w.period_s + 1e-9)
            .map(|w| (w.input, w.action))
    }
}
