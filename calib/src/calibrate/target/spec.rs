//! The printed pattern of the target, parsed from `--target`.

use calib_targets_charuco::{Dictionary, resolve_dictionary};
use nalgebra::Vector2;

/// Kind of the target's points.
#[derive(Clone, Copy, Debug)]
pub enum Kind {
    /// Inner corners of a chessboard.
    Chessboard,
    /// Inner corners of a chessboard with ArUco markers in its white squares.
    Charuco {
        /// Side of a marker as a fraction of a square's side.
        marker: f64,
        /// Dictionary of the markers.
        dictionary: Dictionary,
    },
    /// Centres of dark discs on a square grid.
    Circles {
        /// Diameter of a disc, metres.
        diameter: f64,
    },
}

/// A flat target: a grid of points.
#[derive(Clone, Copy, Debug)]
pub struct Target {
    /// Kind of the points.
    pub kind: Kind,
    /// Columns of points.
    pub cols: usize,
    /// Rows of points.
    pub rows: usize,
    /// Distance between neighbouring points, metres.
    pub spacing: f64,
}

/// Error of the text of `--target`.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "--target {text}: {problem}; give chessboard:COLSxROWS:SQUARE (inner corners, metres), charuco:COLSxROWS:SQUARE:MARKER:DICTIONARY (squares, metres; for example DICT_4X4_50) or circles:COLSxROWS:SPACING:DIAMETER (metres)"
)]
pub struct TargetError {
    /// The text.
    pub text: String,
    /// The problem.
    pub problem: String,
}

/// Valid number of columns and of rows of points.
const GRID_SIDE: std::ops::RangeInclusive<usize> = 3..=200;
/// Valid range of a length on the target, metres. A value outside it has the wrong unit.
const LENGTH_M: std::ops::RangeInclusive<f64> = 0.0005..=0.5;

impl Target {
    /// Parses a text such as "chessboard:9x6:0.025".
    ///
    /// # Errors
    /// The problem and the valid forms.
    pub fn parse(text: &str) -> Result<Self, TargetError> {
        let refuse = |problem: String| TargetError { text: text.to_owned(), problem };
        let parts: Vec<&str> = text.split(':').map(str::trim).collect();
        let [kind, size, spacing, rest @ ..] = parts.as_slice() else {
            return Err(refuse("it has too few parts".to_owned()));
        };
        let (cols, rows) = size
            .split_once(['x', 'X'])
            .and_then(|(a, b)| Some((a.parse::<usize>().ok()?, b.parse::<usize>().ok()?)))
            .ok_or_else(|| refuse(format!("{size:?} is not COLSxROWS")))?;
        let spacing = length(spacing).map_err(&refuse)?;
        let target = match (*kind, rest) {
            ("chessboard", []) => Self { kind: Kind::Chessboard, cols, rows, spacing },
            ("charuco", [marker, dictionary]) => {
                let marker = length(marker).map_err(&refuse)? / spacing;
                if !(0.3..1.0).contains(&marker) {
                    return Err(refuse(format!("a marker of {marker:.3} squares does not fit into a square")));
                }
                let dictionary = resolve_dictionary(dictionary)
                    .ok_or_else(|| refuse(format!("there is no marker dictionary {dictionary:?}")))?;
                // The points are the inner corners, one fewer than the squares.
                let less = |n: usize| n.saturating_sub(1);
                Self { kind: Kind::Charuco { marker, dictionary }, cols: less(cols), rows: less(rows), spacing }
            }
            ("circles", [diameter]) => {
                let diameter = length(diameter).map_err(&refuse)?;
                if diameter >= spacing {
                    return Err(refuse("the discs would touch: the diameter must be less than the spacing".to_owned()));
                }
                Self { kind: Kind::Circles { diameter }, cols, rows, spacing }
            }
            ("chessboard" | "charuco" | "circles", _) => {
                return Err(refuse(format!("wrong number of parts for {kind}")));
            }
            _ => return Err(refuse(format!("{kind:?} is not a kind of target"))),
        };
        if !GRID_SIDE.contains(&target.cols) || !GRID_SIDE.contains(&target.rows) {
            return Err(refuse(format!(
                "a grid of {}x{} points is outside the supported range of 3 to 200 points per side",
                target.cols, target.rows
            )));
        }
        Ok(target)
    }

    /// Number of points.
    pub fn count(&self) -> usize {
        self.cols * self.rows
    }

    /// Position of a point on the target, metres: x along the rows, y down, the first point at the origin.
    pub fn point(&self, index: usize) -> Vector2<f64> {
        let (c, r) = (index % self.cols, index / self.cols);
        Vector2::new(c as f64, r as f64) * self.spacing
    }

    /// Width and height between the outermost points, metres.
    pub fn size(&self) -> Vector2<f64> {
        Vector2::new((self.cols - 1) as f64, (self.rows - 1) as f64) * self.spacing
    }

    /// Index of the point in a column and row.
    pub fn index(&self, col: usize, row: usize) -> usize {
        row * self.cols + col
    }

    /// Diameter of a disc, metres; `None` for targets with corners.
    pub fn disc(&self) -> Option<f64> {
        match self.kind {
            Kind::Circles { diameter } => Some(diameter),
            Kind::Chessboard | Kind::Charuco { .. } => None,
        }
    }

    /// Whether markers identify every point, so that a part of the target is sufficient.
    pub fn has_ids(&self) -> bool {
        matches!(self.kind, Kind::Charuco { .. })
    }

    /// The rotations that map the grid onto itself, as permutations: the new index for each index. The first is the
    /// identity. Colours of squares are not considered.
    pub fn rotations(&self) -> Vec<Vec<usize>> {
        let (n, m) = (self.cols, self.rows);
        let turn = |f: &dyn Fn(usize, usize) -> (usize, usize)| -> Vec<usize> {
            (0..self.count())
                .map(|k| {
                    let (c, r) = f(k % n, k / n);
                    self.index(c, r)
                })
                .collect()
        };
        let mut out = vec![turn(&|c, r| (c, r))];
        if self.has_ids() {
            return out;
        }
        out.push(turn(&|c, r| (n - 1 - c, m - 1 - r)));
        if n == m {
            out.push(turn(&|c, r| (r, n - 1 - c)));
            out.push(turn(&|c, r| (n - 1 - r, c)));
        }
        out
    }
}

/// Parses a length in metres.
fn length(text: &str) -> Result<f64, String> {
    let v: f64 = text.parse().map_err(|_| format!("{text:?} is not a length in metres"))?;
    if !LENGTH_M.contains(&v) {
        return Err(format!("{text} m is outside the range of lengths on a target, 0.0005 to 0.5 m (25 mm is 0.025)"));
    }
    Ok(v)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn valid_texts_are_parsed_and_invalid_ones_rejected_with_a_reason() {
        let t = Target::parse("chessboard:9x6:0.025").unwrap();
        assert_eq!((t.cols, t.rows, t.spacing, t.count()), (9, 6, 0.025, 54));
        assert_eq!(t.point(10), Vector2::new(0.025, 0.025));
        let t = Target::parse("charuco:8x6:0.03:0.022:DICT_4X4_50").unwrap();
        assert_eq!((t.cols, t.rows), (7, 5));
        assert_eq!(Target::parse("circles:7x5:0.02:0.01").unwrap().disc(), Some(0.01));
        for (bad, why) in [
            ("chessboard:9x6:25", "0.025"),
            ("chessboard:9:0.025", "COLSxROWS"),
            ("chessboard:1x6:0.025", "1x6"),
            ("charuco:8x6:0.03:0.04:DICT_4X4_50", "fit"),
            ("charuco:8x6:0.03:0.02:DICT_9", "dictionary"),
            ("circles:7x5:0.02:0.03", "touch"),
            ("rings:7x5:0.02", "kind"),
            ("chessboard", "too few"),
            ("circles:7x5:0.02", "number of parts"),
        ] {
            let e = Target::parse(bad).unwrap_err().to_string();
            assert!(e.contains(why) && e.contains(bad), "{e}");
        }
    }

    #[test]
    fn rotations_are_permutations_that_preserve_handedness() {
        for text in ["chessboard:9x6:0.025", "chessboard:6x6:0.025"] {
            let t = Target::parse(text).unwrap();
            let rotations = t.rotations();
            assert_eq!(rotations.len(), if t.cols == t.rows { 4 } else { 2 });
            for map in rotations {
                let mut seen = map.clone();
                seen.sort_unstable();
                assert!(seen.into_iter().eq(0..t.count()));
                let p = |k: usize| t.point(map[k]);
                let (x, y) = (p(1) - p(0), p(t.cols) - p(0));
                assert!(x.x * y.y - x.y * y.x > 0.0);
            }
        }
    }
}
