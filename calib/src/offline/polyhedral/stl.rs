//! STL, binary or text: the two look alike at the start, so the length decides.

use super::read::Problem;
use graspd_rt::geom::Vec3;

/// Bytes before the first triangle of a binary file: a free text of 80 and the number of triangles.
const HEAD: usize = 84;
/// Bytes of a triangle: normal, three corners, an attribute that has no meaning.
const EACH: usize = 50;

/// Corners of every triangle, in the file's unit.
pub(super) fn read(bytes: &[u8]) -> Result<Vec<[Vec3; 3]>, Problem> {
    // Binary files may begin with the word "solid" as well; only a text has "facet" or "endsolid" soon after it.
    let start = bytes.get(..bytes.len().min(2048)).unwrap_or(bytes);
    let head = String::from_utf8_lossy(start).to_ascii_lowercase();
    let stated = bytes.get(80..HEAD).and_then(|b| b.try_into().ok()).map(u32::from_le_bytes);
    let fits = stated.is_some_and(|n| bytes.len() == HEAD + EACH * n as usize);
    if !fits
        && head.trim_start_matches('\u{feff}').trim_start().starts_with("solid")
        && (head.contains("facet") || head.contains("endsolid"))
    {
        return text(String::from_utf8_lossy(bytes).trim_start_matches('\u{feff}'));
    }
    let Some(count) = stated else {
        return Err(Problem::new(
            format!("byte {}: it ends inside the 84 bytes at the start of a binary STL", bytes.len()),
            "export the part again; a text STL begins with \"solid\"",
        ));
    };
    let needed = HEAD as u64 + EACH as u64 * u64::from(count);
    let have = bytes.len() as u64;
    if have < needed {
        return Err(Problem::new(
            format!("byte {have}: it ends there, but the {count} triangles stated at byte 80 need {needed} bytes"),
            "the file is cut off: copy or export it again",
        ));
    }
    let rest = bytes.get(HEAD + EACH * count as usize..).unwrap_or(&[]);
    if rest.iter().any(|b| *b != 0) {
        return Err(Problem::new(
            format!("byte {needed}: {} more bytes follow the {count} triangles stated at byte 80", rest.len()),
            "the count is wrong, and a part of the part would be missing: export it again",
        ));
    }
    let mut out = Vec::with_capacity(count as usize);
    for (k, raw) in bytes.get(HEAD..HEAD + EACH * count as usize).unwrap_or(&[]).chunks_exact(EACH).enumerate() {
        let number = |i: usize| {
            let at = 12 + 4 * i;
            raw.get(at..at + 4).and_then(|b| b.try_into().ok()).map_or(f64::NAN, |b| f64::from(f32::from_le_bytes(b)))
        };
        let corner = |c: usize| Vec3::new(number(3 * c), number(3 * c + 1), number(3 * c + 2));
        let t = [corner(0), corner(1), corner(2)];
        if t.iter().flat_map(|v| v.iter()).any(|x| !x.is_finite()) {
            return Err(Problem::new(
                format!("byte {}: triangle {k} has a corner that is not a finite number", HEAD + EACH * k),
                "repair or export the part again",
            ));
        }
        out.push(t);
    }
    Ok(out)
}

/// A text STL: words, wherever its writer broke the lines.
fn text(text: &str) -> Result<Vec<[Vec3; 3]>, Problem> {
    // Old programs end lines with a carriage return alone.
    let lines = text.split(['\n', '\r']);
    let mut line_no = 0;
    let mut after_return = false;
    let mut words: Vec<(usize, &str)> = Vec::new();
    let mut at = 0;
    for line in lines {
        // A carriage return and a line feed together are one end of a line.
        if !(after_return && line.is_empty()) {
            line_no += 1;
        }
        words.extend(line.split_whitespace().map(|w| (line_no, w)));
        at += line.len() + 1;
        after_return = text.as_bytes().get(at - 1) == Some(&b'\r') && text.as_bytes().get(at) == Some(&b'\n');
    }
    let is = |k: usize, word: &str| words.get(k).is_some_and(|w| w.1.eq_ignore_ascii_case(word));
    // A name may be any words, up to the end of its line, or to what can only be the next keyword where all stands on one line.
    let name_end = |from: usize, line: usize| {
        let ends = |k: usize| {
            words.get(k).is_none_or(|w| w.0 != line)
                || (is(k, "facet") && is(k + 1, "normal"))
                || (is(k, "endsolid") && k > from)
        };
        (from..=words.len()).find(|k| ends(*k)).unwrap_or(words.len())
    };
    let mut out = Vec::new();
    let mut corners: Vec<Vec3> = Vec::with_capacity(3);
    let (mut in_solid, mut in_facet) = (false, false);
    let mut k = 0;
    while let Some((line, word)) = words.get(k).copied() {
        let wrong = |what: String| Problem::new(format!("line {line}: {what}"), "repair or export the part again");
        k += 1;
        match word.to_ascii_lowercase().as_str() {
            "solid" if !in_facet => {
                in_solid = true;
                k = name_end(k, line);
            }
            "endsolid" if in_facet => return Err(wrong("the solid ends inside a facet".to_owned())),
            "endsolid" => {
                in_solid = false;
                k = name_end(k, line);
            }
            "facet" if in_facet => return Err(wrong("a facet begins inside another".to_owned())),
            "facet" if in_solid => {
                in_facet = true;
                // The normal follows from the corners; what stands here is often wrong or not even a number.
                if is(k, "normal") {
                    k += 1;
                    k += words.iter().skip(k).take(3).take_while(|w| !w.1.eq_ignore_ascii_case("outer")).count();
                }
            }
            "outer" if in_facet && is(k, "loop") => k += 1,
            "endloop" if in_facet => {}
            "vertex" if in_facet => {
                let xyz: Vec<f64> = words.iter().skip(k).take(3).map_while(|w| w.1.parse().ok()).collect();
                // On its own line nothing else may follow: "1 2 3 4" or "1,5" is somebody else's format.
                let next = words.get(k + 3);
                let clean = next.is_none_or(|w| w.0 != line || w.1.chars().all(|c| c.is_ascii_alphabetic()));
                match xyz.as_slice() {
                    [x, y, z] if clean && xyz.iter().all(|v| v.is_finite()) => corners.push(Vec3::new(*x, *y, *z)),
                    _ => {
                        let said: Vec<&str> =
                            words.iter().skip(k - 1).take_while(|w| w.0 == line).take(6).map(|w| w.1).collect();
                        return Err(wrong(format!("\"{}\" is not a vertex with three finite numbers", said.join(" "))));
                    }
                }
                k += 3;
            }
            "endfacet" if in_facet => {
                match corners.as_slice() {
                    [a, b, c] => out.push([*a, *b, *c]),
                    _ => return Err(wrong(format!("the facet that ends here has {} corners, not 3", corners.len()))),
                }
                corners.clear();
                in_facet = false;
            }
            _ => return Err(wrong(format!("\"{word}\" has no place here in a text STL"))),
        }
    }
    if in_solid || in_facet {
        return Err(Problem::new(
            format!("line {line_no}: it ends inside a {}", if in_facet { "facet" } else { "solid" }),
            "the file is cut off: copy or export it again",
        ));
    }
    Ok(out)
}
