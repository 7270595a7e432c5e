//! Coverage: positions of the target in the images, and its tilts.

use super::Pair;
use super::parameters::State;
use graspd_rt::geom::Vec3;

/// Columns and rows of cells of an image.
pub const CELLS: (usize, usize) = (8, 6);
/// Minimum tilt of a board, degrees. A smaller tilt contributes little information about the focal length.
pub const MIN_TILT_DEG: f64 = 15.0;

/// Coverage of the images.
#[derive(Clone, Debug, PartialEq)]
pub struct Coverage {
    /// Number of points per cell, left and right image, row by row.
    pub cells: [Vec<usize>; 2],
    /// Tilt of the board against the left image plane in each pair, degrees, about the image's x and y axes.
    pub tilts_deg: Vec<[f64; 2]>,
    /// Distance of the board's middle from the left camera in each pair, metres.
    pub distances_m: Vec<f64>,
}

impl Coverage {
    /// Coverage of the pairs used.
    pub fn of(pairs: &[Pair], state: &State) -> Self {
        let mut cells = [vec![0; CELLS.0 * CELLS.1], vec![0; CELLS.0 * CELLS.1]];
        for p in pairs {
            for (v, camera) in [&state.rig.left, &state.rig.right].into_iter().enumerate() {
                for s in &p.seen[v] {
                    let cell = |x: f64, size: u32, n: usize| {
                        ((x + 0.5) / f64::from(size) * n as f64).clamp(0.0, n as f64 - 1.0) as usize
                    };
                    let (i, j) = (cell(s.at.x, camera.width, CELLS.0), cell(s.at.y, camera.height, CELLS.1));
                    if let Some(c) = cells[v].get_mut(j * CELLS.0 + i) {
                        *c += 1;
                    }
                }
            }
        }
        let tilts_deg = state
            .left_from_board
            .iter()
            .map(|p| {
                let n = p.rotation * Vec3::z();
                let n = if n.z < 0.0 { -n } else { n };
                [n.y.atan2(n.z).to_degrees(), n.x.atan2(n.z).to_degrees()]
            })
            .collect();
        let distances_m = state.left_from_board.iter().map(|p| p.translation.z).collect();
        Self { cells, tilts_deg, distances_m }
    }

    /// Fraction of the cells of a view that contain points.
    pub fn covered(&self, view: usize) -> f64 {
        self.cells[view].iter().filter(|c| **c > 0).count() as f64 / self.cells[view].len() as f64
    }

    /// Number of pairs with the board tilted about the positive x, negative x, positive y and negative y axis.
    pub fn tilted(&self) -> [usize; 4] {
        let count = |axis: usize, sign: f64| self.tilts_deg.iter().filter(|t| t[axis] * sign > MIN_TILT_DEG).count();
        [count(0, 1.0), count(0, -1.0), count(1, 1.0), count(1, -1.0)]
    }

    /// Range of the middle 80 % of the board distances, metres.
    pub fn usual_range_m(&self) -> [f64; 2] {
        let mut d = self.distances_m.clone();
        d.sort_by(f64::total_cmp);
        let at = |part: f64| d.get((part * (d.len().max(1) - 1) as f64).round() as usize).copied().unwrap_or(1.0);
        [at(0.1), at(0.9)]
    }

    /// Messages about missing coverage.
    pub fn gaps(&self) -> Vec<String> {
        let mut out = Vec::new();
        for (v, name) in ["left", "right"].into_iter().enumerate() {
            let covered = self.covered(v);
            if covered < 0.7 {
                out.push(format!(
                    "the target covers only {:.0} % of the {name} image: take images with the target at the borders and corners",
                    100.0 * covered
                ));
            }
        }
        let names = [
            "with the top towards the camera",
            "with the top away from the camera",
            "turned to the left",
            "turned to the right",
        ];
        let missing: Vec<&str> =
            self.tilted().iter().zip(names).filter(|(n, _)| **n == 0).map(|(_, name)| name).collect();
        if !missing.is_empty() {
            out.push(format!(
                "no image has the target tilted by more than {MIN_TILT_DEG:.0} degrees {}",
                missing.join(" or ")
            ));
        }
        out
    }
}
