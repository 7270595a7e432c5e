//! A progress line on standard error.

use std::io::{IsTerminal, Write};
use std::time::{Duration, Instant};

/// Work that ends within this time prints nothing.
const SILENT: Duration = Duration::from_millis(500);
/// Shortest time between two updates of the line on a terminal.
const UPDATE_PERIOD: Duration = Duration::from_millis(100);

/// Progress of one piece of work. On a terminal one line is rewritten and erased at the end; elsewhere a single line is
/// printed once the work takes long.
pub(super) struct Progress<W: Write = std::io::Stderr> {
    what: &'static str,
    out: W,
    terminal: bool,
    begun: Instant,
    /// Time of the last update.
    shown: Option<Instant>,
}

impl Progress {
    /// Starts now.
    pub(super) fn new(what: &'static str) -> Self {
        let out = std::io::stderr();
        Self { what, terminal: out.is_terminal(), out, begun: Instant::now(), shown: None }
    }
}

impl<W: Write> Progress<W> {
    /// Reports that a fraction of the work, 0 to 1, is done.
    pub(super) fn at(&mut self, fraction: f64) {
        self.at_time(fraction, Instant::now());
    }

    fn at_time(&mut self, fraction: f64, now: Instant) {
        let elapsed = now.saturating_duration_since(self.begun);
        let due = match self.shown {
            None => elapsed >= SILENT,
            Some(last) => self.terminal && now.saturating_duration_since(last) >= UPDATE_PERIOD,
        };
        if !due {
            return;
        }
        self.shown = Some(now);
        let percent = 100.0 * fraction.clamp(0.0, 1.0);
        // A progress line that cannot be written is no reason to fail.
        let _ = match self.terminal {
            true => write!(self.out, "\r\x1b[K{}: {percent:.0} %", self.what).and_then(|()| self.out.flush()),
            false => writeln!(self.out, "{}: {percent:.0} % after {:.1} s", self.what, elapsed.as_secs_f64()),
        };
    }
}

impl<W: Write> Drop for Progress<W> {
    fn drop(&mut self) {
        if self.terminal && self.shown.is_some() {
            let _ = write!(self.out, "\r\x1b[K").and_then(|()| self.out.flush());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The text that is written when progress is reported at these times, in milliseconds.
    fn written(terminal: bool, times: &[u64]) -> String {
        let mut text = Vec::new();
        let begun = Instant::now();
        let mut p = Progress { what: "searching", out: &mut text, terminal, begun, shown: None };
        for ms in times {
            p.at_time(*ms as f64 * 1e-3, begun + Duration::from_millis(*ms));
        }
        drop(p);
        String::from_utf8(text).unwrap()
    }

    #[test]
    fn short_work_is_silent_and_long_work_reports_once_or_keeps_a_terminal_line_updated() {
        assert_eq!(written(false, &[0, 100, 499]), "");
        assert_eq!(written(true, &[0, 100, 499]), "");
        assert_eq!(written(false, &[0, 501, 620, 900]), "searching: 50 % after 0.5 s\n");
        let live = written(true, &[0, 501, 550, 620, 900]);
        assert_eq!(live, "\r\x1b[Ksearching: 50 %\r\x1b[Ksearching: 62 %\r\x1b[Ksearching: 90 %\r\x1b[K");
    }
}
