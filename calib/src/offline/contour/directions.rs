//! Look-up of the edge directions near each pixel: it rejects most points of a wrong trial ellipse without a search.
//!
//! A trial ellipse is scored at up to 160 points, and a seed has about a thousand trials. Near most points of a wrong
//! ellipse there are edges, but with other directions. Each pixel therefore stores, as bits, the sectors of normals
//! that an edge within reach could match. A normal in any other sector certainly has no edge; for the rest the edges
//! themselves are searched. Pixels are filled tile by tile on first access: most of an image is never used.

use crate::offline::edges::EdgeMap;
use crate::offline::edges::arcs::IdealEdges;
use graspd_rt::geom::Pixel;
use std::cell::OnceCell;

/// Side of a tile, pixels: its words fill one page of memory.
const TILE: usize = 32;
/// Largest distance to either side that the search around a point covers, pixels.
pub(super) const REACH_PX: i32 = 3;
/// Cosine of the largest angle between an edge's direction and a normal that it matches.
pub(super) const MIN_COSINE: f64 = 0.94;
/// Slightly more than that angle (19.95 degrees), so that rounding at the end of a sector cannot lose an edge.
const ANGLE_DEG: f64 = 20.0;
/// Sectors of a quarter turn: the full turn fits one word.
const QUARTER: u32 = 8;

type Tile = [[u32; TILE]; TILE];

/// The tiles of an image.
#[derive(Clone, Debug)]
pub(super) struct Directions {
    columns: usize,
    tiles: Vec<OnceCell<Box<Tile>>>,
}

impl Directions {
    pub(super) fn new(width: usize, height: usize) -> Self {
        let columns = width.div_ceil(TILE);
        Self { columns, tiles: vec![OnceCell::new(); columns * height.div_ceil(TILE)] }
    }

    /// Whether an edge within reach of a raw pixel could have the direction `towards_bright` (ideal pixels) to within
    /// [`MIN_COSINE`]. The pixel must be inside the image.
    pub(super) fn may_have_edge(&self, edges: (&EdgeMap, &IdealEdges), raw: Pixel, towards_bright: Pixel) -> bool {
        let (x, y) = (raw.x.round() as usize, raw.y.round() as usize);
        let Some(tile) = self.tiles.get(y / TILE * self.columns + x / TILE) else { return true };
        let tile = tile.get_or_init(|| fill_tile(edges, x / TILE * TILE, y / TILE * TILE));
        tile[y % TILE][x % TILE] & 1 << sector(towards_bright) != 0
    }
}

/// Fills the tile whose first pixel is `(x0, y0)`.
fn fill_tile((map, ideal): (&EdgeMap, &IdealEdges), x0: usize, y0: usize) -> Box<Tile> {
    let mut tile = Box::new([[0u32; TILE]; TILE]);
    let first = Pixel::new(x0 as f64, y0 as f64);
    map.within(first, first.add_scalar((TILE - 1) as f64), REACH_PX, |k, column, row| {
        let Some(edge) = ideal.get(k) else { return };
        let sectors = sectors_round(edge.towards_bright);
        let span = |at: usize, start: usize| {
            let reach = REACH_PX as usize;
            (at.saturating_sub(reach).max(start) - start)..(at + reach + 1).min(start + TILE) - start
        };
        for line in tile.get_mut(span(row, y0)).unwrap_or(&mut []) {
            line.get_mut(span(column, x0)).unwrap_or(&mut []).iter_mut().for_each(|w| *w |= sectors);
        }
    });
    tile
}

/// Sector of a direction. The sectors follow the angle in equal steps of `|y| / (|x| + |y|)`, which needs no arc
/// tangent.
fn sector(d: Pixel) -> u32 {
    let part = d.y.abs() / (d.x.abs() + d.y.abs());
    let quarters = match (d.x >= 0.0, d.y >= 0.0) {
        (true, true) => part,
        (false, true) => 2.0 - part,
        (false, false) => 2.0 + part,
        (true, false) => 4.0 - part,
    };
    ((quarters * f64::from(QUARTER)) as u32).min(4 * QUARTER - 1)
}

/// The sectors of all directions at most [`ANGLE_DEG`] from one, as bits.
fn sectors_round(d: Pixel) -> u32 {
    let (sin, cos) = ANGLE_DEG.to_radians().sin_cos();
    let from = sector(Pixel::new(cos * d.x + sin * d.y, cos * d.y - sin * d.x));
    let to = sector(Pixel::new(cos * d.x - sin * d.y, cos * d.y + sin * d.x));
    let count = (to + 4 * QUARTER - from) % (4 * QUARTER) + 1;
    ((1u32 << count) - 1).rotate_left(from)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::offline::contour::ViewEdges;
    use crate::offline::edges::grey_image::GreyImage;
    use graspd_rt::geom::{Camera, Distortion};

    #[test]
    fn no_matching_edge_is_lost_and_most_normals_have_none() {
        let distortion = Distortion { k1: -0.15, k2: 0.04, p1: 1e-3, ..Distortion::default() };
        let camera = Camera { width: 200, height: 170, fx: 180.0, fy: 178.0, cx: 99.0, cy: 84.0, distortion };
        // Stripes and discs: edges of every direction, up to the border.
        let grey = |x: f64, y: f64| {
            128.0 + 60.0 * (0.31 * x + 0.12 * y).sin() + 55.0 * (0.4 * (x - 90.0).hypot(y - 60.0)).cos()
        };
        let data = (0..200 * 170).map(|i| grey(f64::from(i % 200), f64::from(i / 200)) as u8).collect();
        let image = GreyImage::new(200, 170, data).unwrap();
        let view = ViewEdges::new(&image, &camera);
        let (mut matched, mut passed, mut asked) = (0, 0, 0);
        for i in 0..4000 {
            let at =
                Pixel::new(6.0 + 187.0 * (f64::from(i) * 0.618).fract(), 6.0 + 157.0 * (f64::from(i) * 0.414).fract());
            let (sin, cos) = (f64::from(i) * 2.4).sin_cos();
            let n = Pixel::new(cos, sin);
            let has = view
                .map
                .near(at, REACH_PX)
                .any(|(k, _)| view.arcs.ideal.get(k).is_some_and(|e| e.towards_bright.dot(&n) > MIN_COSINE));
            let may = view.may_have_edge(at, n);
            assert!(may || !has, "{at} {n}");
            asked += 1;
            matched += usize::from(has);
            passed += usize::from(may);
        }
        assert!(matched > 200 && passed < 2 * matched && 2 * passed < asked, "{matched} {passed} {asked}");
    }

    #[test]
    fn sectors_follow_the_angle_round() {
        for i in 0..3600 {
            let (sin, cos) = (f64::from(i) * 0.1f64.to_radians()).sin_cos();
            let round = sectors_round(Pixel::new(cos, sin));
            for off in [-19.95f64, -12.0, 0.0, 7.0, 19.95] {
                let (s, c) = (f64::from(i) * 0.1f64.to_radians() + off.to_radians()).sin_cos();
                assert!(round & 1 << sector(Pixel::new(c, s)) != 0, "{i} {off}");
            }
            assert!(round.count_ones() <= 7);
        }
    }
}
