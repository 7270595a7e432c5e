//! Round blobs of an entire image, in one pass per threshold and without a heap.
//!
//! The image is divided into tiles. A pixel is compared with levels of its tile and the eight around it, so that discs
//! are found in a shaded or unevenly lit image as well. There are two levels for each polarity: halfway between darkest
//! and lightest finds discs on a uniform background, between the mean and the extreme finds a disc next to something
//! much lighter or darker. Runs are linked row by row. A blob is evaluated and released as soon as it ends, so that
//! memory depends on the width of the image and not on its content.

use crate::geom::Pixel;
use crate::image::ImageView;
use crate::math;

/// Blobs kept per view.
pub const MAX_BLOBS: usize = 192;
const MAX_TILES: usize = 4096;
const MAX_RUNS: usize = 2048;
const MAX_LIVE: usize = 2048;
const NONE: u16 = u16::MAX;

/// A round blob.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Blob {
    /// Centroid, pixels.
    pub centre: Pixel,
    /// Larger semi-axis of the ellipse of the same moments, pixels.
    pub major: f64,
    /// Smaller semi-axis, pixels.
    pub minor: f64,
    /// Darker than its surroundings.
    pub dark: bool,
    /// Relative difference between its area and that of the ellipse of the same moments: 0 is an ellipse.
    pub misfit: f64,
}

#[derive(Clone, Copy)]
struct Tile {
    low: u8,
    high: u8,
    mean: u8,
}

#[derive(Clone, Copy)]
struct Levels {
    /// Range of the tile: a tile entirely on one side of its level is not examined pixel by pixel.
    own: [u8; 2],
    /// Levels below which a pixel is dark: by the middle and by the mean.
    dark: [u8; 2],
    /// Levels above which a pixel is light, likewise.
    light: [u8; 2],
}

#[derive(Clone, Copy)]
struct Run {
    from: u16,
    to: u16,
    part: u16,
}

#[derive(Clone, Copy)]
struct Part {
    parent: u16,
    last_row: u16,
    border: bool,
    area: u32,
    x: u64,
    y: u64,
    xx: u64,
    xy: u64,
    yy: u64,
}

const NO_TILE: Tile = Tile { low: 255, high: 0, mean: 0 };
const NO_LEVELS: Levels = Levels { own: [0, 255], dark: [0; 2], light: [255; 2] };
const NO_RUN: Run = Run { from: 0, to: 0, part: NONE };
const NO_PART: Part = Part { parent: NONE, last_row: 0, border: false, area: 0, x: 0, y: 0, xx: 0, xy: 0, yy: 0 };

/// Working memory of blob detection, about 250 kB.
pub(crate) struct BlobScratch {
    tiles: [Tile; MAX_TILES],
    levels: [Levels; MAX_TILES],
    runs: [[Run; MAX_RUNS]; 2],
    parts: [Part; MAX_LIVE],
    free: [u16; MAX_LIVE],
    freed: usize,
    merged: heapless::Vec<u16, MAX_LIVE>,
}

/// Limits of the blobs to be found.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BlobLimits {
    pub(crate) min_contrast: f64,
    pub(crate) min_radius: f64,
    pub(crate) max_radius: f64,
}

impl BlobScratch {
    pub(crate) const fn new() -> Self {
        Self {
            tiles: [NO_TILE; MAX_TILES],
            levels: [NO_LEVELS; MAX_TILES],
            runs: [[NO_RUN; MAX_RUNS]; 2],
            parts: [NO_PART; MAX_LIVE],
            free: [0; MAX_LIVE],
            freed: 0,
            merged: heapless::Vec::new(),
        }
    }

    /// Finds the round blobs of an image, dark and light; the roundest ones if there are more than [`MAX_BLOBS`].
    pub(crate) fn detect(
        &mut self,
        image: &ImageView<'_>,
        limits: &BlobLimits,
        out: &mut heapless::Vec<Blob, MAX_BLOBS>,
    ) {
        out.clear();
        let mut side = 32;
        while image.width().div_ceil(side) * image.height().div_ceil(side) > MAX_TILES {
            side += 8;
        }
        self.survey(image, side, limits.min_contrast);
        for dark in [true, false] {
            for kind in 0..2 {
                self.label(image, side, dark, kind, limits, out);
            }
        }
    }

    /// Darkest, lightest and mean grey of every tile, then the levels from each tile and its neighbours.
    fn survey(&mut self, image: &ImageView<'_>, side: usize, min_contrast: f64) {
        let (columns, rows) = (image.width().div_ceil(side), image.height().div_ceil(side));
        for j in 0..rows {
            for i in 0..columns {
                let (mut low, mut high, mut sum, mut n) = (255_u8, 0_u8, 0_u32, 0_u32);
                for y in j * side..((j + 1) * side).min(image.height()) {
                    let row = image.row(y);
                    for &v in row.get(i * side..((i + 1) * side).min(row.len())).unwrap_or(&[]) {
                        low = low.min(v);
                        high = high.max(v);
                        sum += u32::from(v);
                        n += 1;
                    }
                }
                if let Some(t) = self.tiles.get_mut(j * columns + i) {
                    *t = Tile { low, high, mean: (sum / n.max(1)) as u8 };
                }
            }
        }
        for j in 0..rows {
            for i in 0..columns {
                let (mut low, mut high, mut sum, mut n) = (255_u8, 0_u8, 0_u32, 0_u32);
                for v in j.saturating_sub(1)..=(j + 1).min(rows - 1) {
                    for u in i.saturating_sub(1)..=(i + 1).min(columns - 1) {
                        let t = self.tiles.get(v * columns + u).copied().unwrap_or(NO_TILE);
                        low = low.min(t.low);
                        high = high.max(t.high);
                        sum += u32::from(t.mean);
                        n += 1;
                    }
                }
                let half = |a: u8, b: u8| ((u16::from(a) + u16::from(b)) / 2) as u8;
                let mean = (sum / n.max(1)) as u8;
                let flat = f64::from(high.saturating_sub(low)) < min_contrast;
                let here = self.tiles.get(j * columns + i).copied().unwrap_or(NO_TILE);
                let own = [here.low, here.high];
                if let Some(l) = self.levels.get_mut(j * columns + i) {
                    *l = if flat {
                        Levels { own, ..NO_LEVELS }
                    } else {
                        Levels {
                            own,
                            dark: [half(low, high), half(low, mean)],
                            light: [half(low, high), half(high, mean)],
                        }
                    };
                }
            }
        }
    }

    fn label(
        &mut self,
        image: &ImageView<'_>,
        side: usize,
        dark: bool,
        kind: usize,
        limits: &BlobLimits,
        out: &mut heapless::Vec<Blob, MAX_BLOBS>,
    ) {
        for (i, f) in self.free.iter_mut().enumerate() {
            *f = i as u16;
        }
        self.freed = MAX_LIVE;
        let columns = image.width().div_ceil(side);
        let (mut before, mut before_len) = (0, 0);
        for y in 0..image.height() {
            let now = 1 - before;
            let levels = self.levels.get(y / side * columns..(y / side + 1) * columns).unwrap_or(&[]);
            let Some(runs) = self.runs.get_mut(now) else { return };
            let len = cut(image.row(y), levels, side, dark, kind, runs);
            self.link(now, len, before, before_len, y, image);
            self.close(before, before_len, y, dark, limits, out);
            (before, before_len) = (now, len);
        }
        self.close(before, before_len, image.height(), dark, limits, out);
    }

    fn root(&self, mut part: u16) -> u16 {
        // Parents cannot form a cycle; the bound only protects against a corrupt table.
        for _ in 0..MAX_LIVE {
            match self.parts.get(usize::from(part)) {
                Some(p) if p.parent != NONE => part = p.parent,
                _ => break,
            }
        }
        part
    }

    /// Links the runs of row `y` to the parts of the row before, creates new parts, and merges parts that meet.
    fn link(&mut self, now: usize, len: usize, before: usize, before_len: usize, y: usize, image: &ImageView<'_>) {
        let mut first = 0;
        self.merged.clear();
        for k in 0..len {
            let Some(&run) = self.runs.get(now).and_then(|r| r.get(k)) else { return };
            let mut part = NONE;
            let mut b = first;
            while b < before_len {
                let Some(&other) = self.runs.get(before).and_then(|r| r.get(b)) else { break };
                if other.to <= run.from {
                    first = b + 1;
                } else if other.from >= run.to {
                    break;
                } else if other.part != NONE {
                    let theirs = self.root(other.part);
                    part = if part == NONE || part == theirs { theirs } else { self.merge(part, theirs) };
                }
                b += 1;
            }
            if part == NONE {
                part = self.fresh();
            }
            let edge = y == 0 || y + 1 == image.height() || run.from == 0 || usize::from(run.to) == image.width();
            if let Some(p) = self.parts.get_mut(usize::from(part)) {
                add(p, &run, y, edge);
            }
            if let Some(r) = self.runs.get_mut(now).and_then(|r| r.get_mut(k)) {
                r.part = part;
            }
        }
        for k in 0..len {
            let Some(part) = self.runs.get(now).and_then(|r| r.get(k)).map(|r| r.part) else { return };
            if part != NONE {
                let root = self.root(part);
                if let Some(r) = self.runs.get_mut(now).and_then(|r| r.get_mut(k)) {
                    r.part = root;
                }
            }
        }
    }

    fn fresh(&mut self) -> u16 {
        let Some(next) = self.freed.checked_sub(1) else { return NONE };
        self.freed = next;
        let Some(&part) = self.free.get(next) else { return NONE };
        if let Some(p) = self.parts.get_mut(usize::from(part)) {
            *p = NO_PART;
        }
        part
    }

    fn release(&mut self, part: u16) {
        if let Some(f) = self.free.get_mut(self.freed) {
            *f = part;
            self.freed += 1;
        }
    }

    fn merge(&mut self, into: u16, from: u16) -> u16 {
        let Some(f) = self.parts.get(usize::from(from)).copied() else { return into };
        if let Some(p) = self.parts.get_mut(usize::from(into)) {
            p.area += f.area;
            p.x += f.x;
            p.y += f.y;
            p.xx += f.xx;
            p.xy += f.xy;
            p.yy += f.yy;
            p.border |= f.border;
            p.last_row = p.last_row.max(f.last_row);
        }
        if let Some(p) = self.parts.get_mut(usize::from(from)) {
            p.parent = into;
        }
        let _ = self.merged.push(from);
        into
    }

    /// Evaluates and releases the parts of the row before that do not continue in row `y`.
    fn close(
        &mut self,
        before: usize,
        before_len: usize,
        y: usize,
        dark: bool,
        limits: &BlobLimits,
        out: &mut heapless::Vec<Blob, MAX_BLOBS>,
    ) {
        for k in 0..before_len {
            let Some(part) = self.runs.get(before).and_then(|r| r.get(k)).map(|r| r.part) else { return };
            if part == NONE {
                continue;
            }
            let Some(p) = self.parts.get_mut(usize::from(part)) else { continue };
            // `area` is zero once a part is closed: several runs of the row may belong to it.
            if p.parent == NONE && usize::from(p.last_row) != y && p.area > 0 {
                let blob = judge(p, dark, limits);
                p.area = 0;
                self.release(part);
                if let Some(blob) = blob {
                    keep(blob, out);
                }
            }
        }
        // No run refers to a merged part any more: those of row `y` refer to roots.
        while let Some(part) = self.merged.pop() {
            self.release(part);
        }
    }
}

/// Cuts a row into runs of pixels beyond the level of their tile; returns their number.
fn cut(row: &[u8], levels: &[Levels], side: usize, dark: bool, kind: usize, runs: &mut [Run; MAX_RUNS]) -> usize {
    let mut len = 0;
    let mut open: Option<usize> = None;
    for (t, (tile, level)) in row.chunks(side).zip(levels).enumerate() {
        let pick = |l: &[u8; 2]| l.get(kind).copied().unwrap_or(0);
        let (below, above) = if dark { (pick(&level.dark), 255) } else { (0, pick(&level.light)) };
        let [low, high] = level.own;
        let (none, all) = (low >= below && high <= above, high < below || low > above);
        if (none && open.is_none()) || (all && open.is_some()) {
            continue;
        }
        for (i, &v) in tile.iter().enumerate() {
            let inside = v < below || v > above;
            if inside != open.is_some() {
                let x = t * side + i;
                match open.take() {
                    None => open = Some(x),
                    Some(from) => {
                        if let Some(r) = runs.get_mut(len) {
                            *r = Run { from: from as u16, to: x as u16, part: NONE };
                            len += 1;
                        }
                    }
                }
            }
        }
    }
    if let (Some(from), Some(r)) = (open, runs.get_mut(len)) {
        *r = Run { from: from as u16, to: row.len() as u16, part: NONE };
        len += 1;
    }
    len
}

/// Adds the moments of a run: sums of x and x squared over from..to in closed form.
fn add(p: &mut Part, run: &Run, y: usize, edge: bool) {
    let (a, b, y) = (u64::from(run.from), u64::from(run.to), y as u64);
    let n = b - a;
    let upto = |m: u64| m * m.saturating_sub(1) / 2;
    let squares = |m: u64| if m == 0 { 0 } else { (m - 1) * m * (2 * m - 1) / 6 };
    let sx = upto(b) - upto(a);
    p.area += n as u32;
    p.x += sx;
    p.y += n * y;
    p.xx += squares(b) - squares(a);
    p.xy += sx * y;
    p.yy += n * y * y;
    p.border |= edge;
    p.last_row = y as u16;
}

/// The ellipse of a part, if it is round enough and has a size that a mark may have.
fn judge(p: &Part, dark: bool, limits: &BlobLimits) -> Option<Blob> {
    let area = f64::from(p.area);
    let largest = core::f64::consts::PI * math::sq(limits.max_radius);
    // The flattest disc to be found is five times as long as wide.
    let smallest = (core::f64::consts::PI * math::sq(limits.min_radius) * 0.2).max(12.0);
    if p.border || area < smallest || area > largest {
        return None;
    }
    let (x, y) = (p.x as f64 / area, p.y as f64 / area);
    // 1/12 is the second moment of a pixel.
    let xx = p.xx as f64 / area - x * x + 1.0 / 12.0;
    let yy = p.yy as f64 / area - y * y + 1.0 / 12.0;
    let xy = p.xy as f64 / area - x * y;
    let (mean, half) = (0.5 * (xx + yy), 0.5 * (xx - yy));
    let root = math::sqrt(half * half + xy * xy);
    let (l1, l2) = (mean + root, mean - root);
    if !(l2 > 0.1) {
        return None;
    }
    let (major, minor) = (2.0 * math::sqrt(l1), 2.0 * math::sqrt(l2));
    let misfit = math::fabs(area / (core::f64::consts::PI * major * minor) - 1.0);
    // The area of a rasterized disc of radius r is accurate to about 0.15 / r, relative.
    let round = misfit < 0.04 + 0.3 / minor && minor > 0.18 * major;
    let fits = major >= limits.min_radius && major <= limits.max_radius;
    (round && fits).then_some(Blob { centre: Pixel::new(x, y), major, minor, dark, misfit })
}

/// Keeps a blob unless it was already found at another level, or the list is full of rounder ones.
fn keep(blob: Blob, out: &mut heapless::Vec<Blob, MAX_BLOBS>) {
    for o in out.iter_mut() {
        let near = math::sq(0.5 * o.minor.max(blob.minor));
        if o.dark == blob.dark && (o.centre - blob.centre).norm_squared() < near {
            if blob.misfit < o.misfit {
                *o = blob;
            }
            return;
        }
    }
    if let Err(blob) = out.push(blob)
        && let Some(worst) = out.iter_mut().max_by(|a, b| a.misfit.total_cmp(&b.misfit))
        && blob.misfit < worst.misfit
    {
        *worst = blob;
    }
}
