//! Cuts the text that arrives on ports 30001 to 30003 into programs.
//!
//! There is no length and no end mark on these ports: a `def` or `sec` is over with the line of its `end`, anything else with its
//! line. An unfinished last line is not started, as on a robot.

/// Largest program taken, bytes.
const LARGEST: usize = 4 << 20;

/// One connection's script input.
#[derive(Debug, Default)]
pub(super) struct ScriptStream {
    /// Lines of the program under way.
    text: Vec<u8>,
    /// Where the line under way begins.
    line_start: usize,
    depth: usize,
    /// The program is too long; it is dropped up to its end.
    overlong: bool,
}

/// What came out of a stream.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Script {
    /// A whole program.
    Program(String),
    /// A program beyond [`LARGEST`] bytes, dropped.
    TooLong,
}

impl ScriptStream {
    /// Takes bytes in any cut; whole programs go to `found`.
    pub(super) fn receive(&mut self, bytes: &[u8], mut found: impl FnMut(Script)) {
        for &b in bytes {
            self.text.push(b);
            if self.text.len() > LARGEST {
                self.overlong = true;
                self.text.clear();
                self.line_start = 0;
            }
            if b == b'\n' {
                self.end_of_line(&mut found);
            }
        }
    }

    fn end_of_line(&mut self, found: &mut impl FnMut(Script)) {
        let line = self.text.get(self.line_start..).unwrap_or_default();
        match first_word(line) {
            b"def" | b"sec" | b"thread" | b"if" | b"while" | b"for" | b"switch" => self.depth += 1,
            b"end" => self.depth = self.depth.saturating_sub(1),
            b"" if self.depth == 0 && self.text.trim_ascii().is_empty() => {
                self.text.clear();
                self.line_start = 0;
                return;
            }
            _ => {}
        }
        self.line_start = self.text.len();
        if self.depth == 0 {
            // A comment alone is not a program yet.
            let only_comments = self.text.split(|b| *b == b'\n').all(|l| first_word(l).is_empty());
            if only_comments && !self.overlong {
                return;
            }
            let text = std::mem::take(&mut self.text);
            self.line_start = 0;
            found(if std::mem::take(&mut self.overlong) {
                Script::TooLong
            } else {
                Script::Program(String::from_utf8_lossy(&text).into_owned())
            });
        }
    }
}

/// The first word of a line, empty for a blank line or a comment.
fn first_word(line: &[u8]) -> &[u8] {
    let line = line.trim_ascii();
    let end = line.iter().position(|b| !(b.is_ascii_alphanumeric() || *b == b'_')).unwrap_or(line.len());
    match line.first() {
        Some(b'#') | None => b"",
        Some(_) => line.get(..end.max(1)).unwrap_or_default(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all(bytes: &[u8], chunk: usize) -> Vec<Script> {
        let (mut stream, mut out) = (ScriptStream::default(), Vec::new());
        for part in bytes.chunks(chunk) {
            stream.receive(part, |s| out.push(s));
        }
        out
    }

    const TWO: &[u8] = b"\n# hello\ndef a():\n  while True:\n    if x: # end\n      sync()\n    end\n  end\nend\ntextmsg(\"end\")\nmovej([";

    #[test]
    fn programs_end_where_they_end_in_every_cut() {
        for chunk in [1, 2, 7, 1000] {
            let programs = all(TWO, chunk);
            assert_eq!(programs.len(), 2, "{programs:?}");
            assert!(matches!(&programs[0], Script::Program(p) if p.ends_with("end\nend\n") && p.contains("def a")));
            assert_eq!(programs[1], Script::Program("textmsg(\"end\")\n".to_owned()));
        }
    }

    #[test]
    fn an_endless_program_is_dropped_and_memory_stays_bounded() {
        let mut stream = ScriptStream::default();
        let mut out = Vec::new();
        stream.receive(b"def a():\n", |s| out.push(s));
        for _ in 0..600_000 {
            stream.receive(b"  x = 1\n", |s| out.push(s));
        }
        assert!(stream.text.len() <= LARGEST);
        stream.receive(b"end\n", |s| out.push(s));
        assert_eq!(out, [Script::TooLong]);
    }
}
