//! A line of progress on standard error: for people who wait, and out of the way of everybody else.

use std::io::{IsTerminal, Write};
use std::time::{Duration, Instant};

/// Nobody wonders what a command does before this.
const SILENT: Duration = Duration::from_millis(500);
/// A line on a terminal is written anew this often at most.
const EVERY: Duration = Duration::from_millis(100);

/// Progress of one piece of work: on a terminal a line that is rewritten and taken away at the end, elsewhere a single line once it takes long.
pub(crate) struct Progress<W: Write = std::io::Stderr> {
    what: &'static str,
    out: W,
    terminal: bool,
    begun: Instant,
    /// When the line was written last.
    shown: Option<Instant>,
}

impl Progress {
    /// Begins now.
    pub(crate) fn new(what: &'static str) -> Self {
        let out = std::io::stderr();
        Self { what, terminal: out.is_terminal(), out, begun: Instant::now(), shown: None }
    }
}

impl<W: Write> Progress<W> {
    /// A part of the work, 0 to 1, is done.
    pub(crate) fn at(&mut self, part: f64) {
        self.at_time(part, Instant::now());
    }

    fn at_time(&mut self, part: f64, now: Instant) {
        let waited = now.saturating_duration_since(self.begun);
        let due = match self.shown {
            None => waited >= SILENT,
            Some(last) => self.terminal && now.saturating_duration_since(last) >= EVERY,
        };
        if !due {
            return;
        }
        self.shown = Some(now);
        let percent = 100.0 * part.clamp(0.0, 1.0);
        // Progress that cannot be written is not worth failing for.
        let _ = match self.terminal {
            true => write!(self.out, "\r\x1b[K{}: {percent:.0} %", self.what).and_then(|()| self.out.flush()),
            false => writeln!(self.out, "{}: {percent:.0} % after {:.1} s", self.what, waited.as_secs_f64()),
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

    /// What is written when the work is asked after at these milliseconds.
    fn written(terminal: bool, times: &[u64]) -> String {
        let mut text = Vec::new();
        let begun = Instant::now();
        let mut p = Progress { what: "looking", out: &mut text, terminal, begun, shown: None };
        for ms in times {
            p.at_time(*ms as f64 * 1e-3, begun + Duration::from_millis(*ms));
        }
        drop(p);
        String::from_utf8(text).unwrap()
    }

    #[test]
    fn short_work_is_silent_and_long_work_says_so_once_or_goes_on_on_a_terminal() {
        assert_eq!(written(false, &[0, 100, 499]), "");
        assert_eq!(written(true, &[0, 100, 499]), "");
        assert_eq!(written(false, &[0, 501, 620, 900]), "looking: 50 % after 0.5 s\n");
        let live = written(true, &[0, 501, 550, 620, 900]);
        assert_eq!(live, "\r\x1b[Klooking: 50 %\r\x1b[Klooking: 62 %\r\x1b[Klooking: 90 %\r\x1b[K");
    }
}
