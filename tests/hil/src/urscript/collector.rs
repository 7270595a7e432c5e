//! Splits the bytes of a script port into uploads.

/// Largest incomplete upload.
const MAX_PENDING_BYTES: usize = super::lexer::MAX_SOURCE_BYTES;

/// One complete upload.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Upload {
    /// Text for [`super::Machine::load_at`].
    Program {
        /// The program.
        text: String,
        /// Line of its beginning in what the client sent, from 1.
        first_line: u32,
    },
    /// The line `stop program`, a command of the port that is not URScript.
    StopProgram,
}

/// Collects uploads: a `def` or `sec` up to its matching `end`, or any other single line. As on the controller, a line
/// takes effect only after its newline.
#[derive(Debug, Default)]
pub struct Collector {
    bytes: Vec<u8>,
    program: String,
    depth: usize,
    /// Complete lines since the beginning of the send.
    lines: u32,
    /// Line at which `program` begins, counted from 0.
    begin: u32,
}

impl Collector {
    /// Takes received bytes, however they are split, and returns the uploads that they complete.
    ///
    /// # Errors
    /// More than 1 MiB without an end; the connection should be closed.
    pub fn push(&mut self, bytes: &[u8]) -> Result<Vec<Upload>, &'static str> {
        let mut out = Vec::new();
        for part in bytes.split_inclusive(|b| *b == b'\n') {
            if self.bytes.len() + self.program.len() + part.len() > MAX_PENDING_BYTES {
                return Err("sent a program of more than 1 MiB");
            }
            self.bytes.extend_from_slice(part);
            if part.ends_with(b"\n") {
                let line = String::from_utf8_lossy(&std::mem::take(&mut self.bytes)).into_owned();
                out.extend(self.line(&line));
            }
        }
        Ok(out)
    }

    /// Restarts the line numbers: the client has paused, so that the next bytes are another text.
    pub fn begin_send(&mut self) {
        if self.depth == 0 && self.bytes.is_empty() && self.program.trim().is_empty() {
            self.lines = 0;
        }
    }

    fn line(&mut self, line: &str) -> Option<Upload> {
        if self.program.is_empty() {
            self.begin = self.lines;
        }
        self.lines = self.lines.saturating_add(1);
        let words = words(line);
        if self.depth == 0 {
            match words.as_slice() {
                // Comments before a program are kept, so that line numbers match the client's text.
                [] => {
                    if !line.trim().is_empty() || !self.program.is_empty() {
                        self.program.push_str(line);
                    }
                    return None;
                }
                [first, second] if first == "stop" && second == "program" => {
                    self.program.clear();
                    return Some(Upload::StopProgram);
                }
                _ => {}
            }
        }
        self.program.push_str(line);
        for word in &words {
            match word.as_str() {
                "def" | "sec" | "thread" | "if" | "while" => self.depth += 1,
                "end" => self.depth = self.depth.saturating_sub(1),
                _ => {}
            }
        }
        (self.depth == 0).then(|| Upload::Program {
            text: std::mem::take(&mut self.program),
            first_line: self.begin.saturating_add(1),
        })
    }
}

/// Words outside strings and comments.
fn words(line: &str) -> Vec<String> {
    let mut out = Vec::new();
    let mut word = String::new();
    let mut quote = None;
    if line.trim_start().starts_with('$') {
        return out;
    }
    for c in line.chars().chain(['\n']) {
        match quote {
            Some(q) if c == q => quote = None,
            Some(_) => {}
            None if c.is_ascii_alphanumeric() || c == '_' => word.push(c),
            None => {
                if !word.is_empty() {
                    out.push(std::mem::take(&mut word));
                }
                match c {
                    '#' => break,
                    '"' | '\'' => quote = Some(c),
                    _ => {}
                }
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "# head\ndef a():\n  if True: # end\n    textmsg(\"end\")\n  end\nend\nset_digital_out(1, True)\nstop program\nsec b():\n x = 1\nend\n";

    #[test]
    fn programs_end_at_their_matching_end_however_the_bytes_are_split() {
        let whole = Collector::default().push(TEXT.as_bytes()).unwrap();
        assert_eq!(whole.len(), 4);
        assert!(
            matches!(&whole[0], Upload::Program { text, first_line: 1 } if text.starts_with("# head\ndef a") && text.ends_with("end\nend\n"))
        );
        assert_eq!(whole[1], Upload::Program { text: "set_digital_out(1, True)\n".into(), first_line: 7 });
        assert_eq!(whole[2], Upload::StopProgram);
        for portion in [1, 2, 3, 7, 50] {
            let mut c = Collector::default();
            let parts: Vec<Upload> = TEXT.as_bytes().chunks(portion).flat_map(|b| c.push(b).unwrap()).collect();
            assert_eq!(parts, whole);
        }
    }

    #[test]
    fn a_line_without_newline_does_not_complete_an_upload() {
        let mut c = Collector::default();
        assert_eq!(c.push(b"def a():\nend").unwrap(), []);
        assert_eq!(c.push(b"\n").unwrap().len(), 1);
    }

    #[test]
    fn memory_is_bounded() {
        let mut c = Collector::default();
        let block = [b'x'; 4096];
        assert!((0..300).any(|_| c.push(&block).is_err()));
    }
}
