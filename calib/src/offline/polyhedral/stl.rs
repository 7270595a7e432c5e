//! STL files, binary or text. Both may begin with "solid", so the file size decides first.

use super::problem::Problem;
use graspd_rt::geom::Vec3;

/// Header of a binary file, bytes: 80 of free text and the number of triangles.
const HEADER_BYTES: usize = 84;
/// A triangle of a binary file, bytes: normal, three corners, and an attribute without a defined meaning.
const TRIANGLE_BYTES: usize = 50;

const EXPORT_AGAIN: &str = "repair the part or export it again";
const CUT_OFF: &str = "the file is cut off: copy or export it again";

/// Corners of every triangle, in the unit of the file.
pub(super) fn read(bytes: &[u8]) -> Result<Vec<[Vec3; 3]>, Problem> {
    // Binary files may begin with "solid" as well; only a text file has "facet" or "endsolid" soon after it.
    let start = bytes.get(..bytes.len().min(2048)).unwrap_or(bytes);
    let head = String::from_utf8_lossy(start).to_ascii_lowercase();
    let stated = bytes.get(80..HEADER_BYTES).and_then(|b| b.try_into().ok()).map(u32::from_le_bytes);
    let size_matches = stated.is_some_and(|n| bytes.len() == HEADER_BYTES + TRIANGLE_BYTES * n as usize);
    if !size_matches
        && head.trim_start_matches('\u{feff}').trim_start().starts_with("solid")
        && (head.contains("facet") || head.contains("endsolid"))
    {
        return Parser::new(String::from_utf8_lossy(bytes).trim_start_matches('\u{feff}')).parse();
    }
    binary(bytes, stated)
}

fn binary(bytes: &[u8], stated: Option<u32>) -> Result<Vec<[Vec3; 3]>, Problem> {
    let Some(count) = stated else {
        return Err(Problem::new(
            format!("byte {}: the file ends inside the 84-byte header of a binary STL", bytes.len()),
            "export the part again; a text STL begins with \"solid\"",
        ));
    };
    let needed = HEADER_BYTES as u64 + TRIANGLE_BYTES as u64 * u64::from(count);
    let have = bytes.len() as u64;
    if have < needed {
        return Err(Problem::new(
            format!(
                "byte {have}: the file ends there, but the {count} triangles stated at byte 80 need {needed} bytes"
            ),
            CUT_OFF,
        ));
    }
    let end = HEADER_BYTES + TRIANGLE_BYTES * count as usize;
    let rest = bytes.get(end..).unwrap_or(&[]);
    if rest.iter().any(|b| *b != 0) {
        return Err(Problem::new(
            format!("byte {needed}: {} more bytes follow the {count} triangles stated at byte 80", rest.len()),
            "the stated count is wrong and triangles would be lost: export the part again",
        ));
    }
    let mut out = Vec::with_capacity(count as usize);
    for (k, raw) in bytes.get(HEADER_BYTES..end).unwrap_or(&[]).chunks_exact(TRIANGLE_BYTES).enumerate() {
        let number = |i: usize| {
            let at = 12 + 4 * i;
            raw.get(at..at + 4).and_then(|b| b.try_into().ok()).map_or(f64::NAN, |b| f64::from(f32::from_le_bytes(b)))
        };
        let corner = |c: usize| Vec3::new(number(3 * c), number(3 * c + 1), number(3 * c + 2));
        let t = [corner(0), corner(1), corner(2)];
        if t.iter().flat_map(|v| v.iter()).any(|x| !x.is_finite()) {
            return Err(Problem::new(
                format!("byte {}: triangle {k} has a corner that is not finite", HEADER_BYTES + TRIANGLE_BYTES * k),
                EXPORT_AGAIN,
            ));
        }
        out.push(t);
    }
    Ok(out)
}

/// The words of a text and their lines, counted from 1. Lines may end with LF, CR LF or CR; returns the last line too.
fn words(text: &str) -> (Vec<(usize, &str)>, usize) {
    let mut line_no = 0;
    let mut after_cr = false;
    let mut words = Vec::new();
    let mut at = 0;
    for line in text.split(['\n', '\r']) {
        // CR LF is one line end.
        if !(after_cr && line.is_empty()) {
            line_no += 1;
        }
        words.extend(line.split_whitespace().map(|w| (line_no, w)));
        at += line.len() + 1;
        after_cr = text.as_bytes().get(at - 1) == Some(&b'\r') && text.as_bytes().get(at) == Some(&b'\n');
    }
    (words, line_no)
}

/// Parser of a text STL. It reads words and ignores how they are distributed over lines.
struct Parser<'a> {
    words: Vec<(usize, &'a str)>,
    last_line: usize,
    /// Index of the next word.
    next: usize,
    in_solid: bool,
    in_facet: bool,
    /// Corners of the current facet.
    corners: Vec<Vec3>,
    out: Vec<[Vec3; 3]>,
}

impl<'a> Parser<'a> {
    fn new(text: &'a str) -> Self {
        let (words, last_line) = words(text);
        let corners = Vec::with_capacity(3);
        Self { words, last_line, next: 0, in_solid: false, in_facet: false, corners, out: Vec::new() }
    }

    fn parse(mut self) -> Result<Vec<[Vec3; 3]>, Problem> {
        while let Some((line, word)) = self.words.get(self.next).copied() {
            self.next += 1;
            self.word(line, word).map_err(|what| Problem::new(format!("line {line}: {what}"), EXPORT_AGAIN))?;
        }
        if self.in_solid || self.in_facet {
            let inside = if self.in_facet { "facet" } else { "solid" };
            return Err(Problem::new(format!("line {}: the file ends inside a {inside}", self.last_line), CUT_OFF));
        }
        Ok(self.out)
    }

    /// Reads one word and the words that belong to it.
    fn word(&mut self, line: usize, word: &str) -> Result<(), String> {
        match word.to_ascii_lowercase().as_str() {
            "solid" if !self.in_facet => {
                self.in_solid = true;
                self.next = self.name_end(line);
            }
            "endsolid" if self.in_facet => return Err("the solid ends inside a facet".to_owned()),
            "endsolid" => {
                self.in_solid = false;
                self.next = self.name_end(line);
            }
            "facet" if self.in_facet => return Err("a facet begins inside another".to_owned()),
            "facet" if self.in_solid => {
                self.in_facet = true;
                // The normal follows from the corners; the stated one is often wrong or not a number.
                if self.is(self.next, "normal") {
                    self.next += 1;
                    let rest = self.words.iter().skip(self.next).take(3);
                    self.next += rest.take_while(|w| !w.1.eq_ignore_ascii_case("outer")).count();
                }
            }
            "outer" if self.in_facet && self.is(self.next, "loop") => self.next += 1,
            "endloop" if self.in_facet => {}
            "vertex" if self.in_facet => self.vertex(line)?,
            "endfacet" if self.in_facet => {
                match self.corners.as_slice() {
                    [a, b, c] => self.out.push([*a, *b, *c]),
                    _ => return Err(format!("the facet that ends here has {} corners, not 3", self.corners.len())),
                }
                self.corners.clear();
                self.in_facet = false;
            }
            _ => return Err(format!("\"{word}\" is not allowed here in a text STL")),
        }
        Ok(())
    }

    fn is(&self, k: usize, word: &str) -> bool {
        self.words.get(k).is_some_and(|w| w.1.eq_ignore_ascii_case(word))
    }

    /// Index of the word after the name of a solid. A name ends with its line or, where everything is on one line,
    /// before "facet normal" or "endsolid".
    fn name_end(&self, line: usize) -> usize {
        let from = self.next;
        let ends = |k: usize| {
            self.words.get(k).is_none_or(|w| w.0 != line)
                || (self.is(k, "facet") && self.is(k + 1, "normal"))
                || (self.is(k, "endsolid") && k > from)
        };
        (from..=self.words.len()).find(|k| ends(*k)).unwrap_or(self.words.len())
    }

    fn vertex(&mut self, line: usize) -> Result<(), String> {
        let k = self.next;
        let xyz: Vec<f64> = self.words.iter().skip(k).take(3).map_while(|w| w.1.parse().ok()).collect();
        // Only a keyword may follow on the same line: "1 2 3 4" or "1,5" is another format.
        let follower = self.words.get(k + 3);
        let clean = follower.is_none_or(|w| w.0 != line || w.1.chars().all(|c| c.is_ascii_alphabetic()));
        match xyz.as_slice() {
            [x, y, z] if clean && xyz.iter().all(|v| v.is_finite()) => self.corners.push(Vec3::new(*x, *y, *z)),
            _ => {
                let words = self.words.iter().skip(k - 1).take_while(|w| w.0 == line).take(6);
                let found: Vec<&str> = words.map(|w| w.1).collect();
                return Err(format!("\"{}\" is not a vertex with three finite numbers", found.join(" ")));
            }
        }
        self.next += 3;
        Ok(())
    }
}
