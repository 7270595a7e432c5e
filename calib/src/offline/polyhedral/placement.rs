//! Placements of the claws on a handle: position along it, depth and opening, and the collision test of the gripper.

use super::bvh::Bvh;
use super::constraints::{Constraints, Rejection};
use super::handles::{BoxHandle, Overlap};
use crate::files::{GripperFile, OrientedBox};
use graspd_rt::geom::{Pose, Vec3};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion};
use std::f64::consts::PI;

/// Smallest distance between the palm and the part, metres.
const MIN_PALM_GAP_M: f64 = 1e-3;
/// Largest gap between each claw and its face at the end of the closing test, metres: down to it the claws must not
/// touch anything.
const CLOSING_GAP_M: f64 = 0.5e-3;
/// Tolerance of width comparisons, metres: mesh files have single precision.
const WIDTH_TOLERANCE_M: f64 = 1e-6;
/// Bisections of the range of depths, which resolve it to 1/64.
const HALVINGS: usize = 6;

/// The dimensions of a claw that determine its contact, in the gripper frame.
pub(super) struct Claw {
    /// Centre of the pads along y (across the approach), metres.
    middle: f64,
    /// Half width of the pads along y, metres.
    pub(super) half_width: f64,
    /// Position of the tips along z from the gripper's origin, metres.
    pub(super) tip: f64,
    /// Length of the pads along the approach, metres.
    pad: f64,
    /// Length of the fingers in front of the palm, metres.
    length: f64,
}

impl Claw {
    /// The pad area that the fingers of both sides have in common.
    pub(super) fn of(gripper: &GripperFile) -> Self {
        let (mut y, mut z) = ((f64::NEG_INFINITY, f64::INFINITY), (f64::NEG_INFINITY, f64::INFINITY));
        for side in [1.0, -1.0] {
            let on = || gripper.fingers.iter().filter(|f| f.side == side).map(|f| f.closed);
            if on().next().is_none() {
                continue;
            }
            let range = |k: usize| {
                on().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), f| {
                    let c = f.frame_from_box.translation.vector[k];
                    (a.min(c - f.half[k]), b.max(c + f.half[k]))
                })
            };
            y = (y.0.max(range(1).0), y.1.min(range(1).1));
            z = (z.0.max(range(2).0), z.1.min(range(2).1));
        }
        if y.0 < y.1 && z.0 < z.1 && y.0.is_finite() {
            let (half_width, pad) = (0.5 * (y.1 - y.0), z.1 - z.0);
            return Self { middle: 0.5 * (y.0 + y.1), half_width, tip: z.1, pad, length: gripper.finger_length };
        }
        let length = gripper.finger_length;
        Self { middle: 0.0, half_width: 5e-3, tip: 0.0, pad: length, length }
    }
}

/// A pose of the gripper on a handle.
#[derive(Clone, Copy, Debug)]
pub(super) struct Placement {
    /// Gripper pose in the mesh frame at the grasp.
    pub(super) pose: Pose,
    /// Jaw opening during the approach, metres.
    pub(super) opening: f64,
    /// Contact area of each claw, square metres.
    pub(super) contact: f64,
}

/// A cell of an overlap in the axes of the handle, metres from the overlap's origin.
#[derive(Clone, Copy)]
struct Cell {
    /// Across the approach.
    side: f64,
    /// Along the approach.
    depth: f64,
    /// Positions of the two faces along the closing direction.
    faces: [f64; 2],
}

/// A test that failed: the reason, the contact area (square metres) and the gripper pose in the mesh frame.
pub(super) type Failed = (Rejection, f64, Pose);

/// The search for placements of one gripper on one handle.
pub(super) struct PlacementSearch<'a> {
    handle: &'a BoxHandle,
    overlap: &'a Overlap,
    tree: &'a Bvh<'a>,
    gripper: &'a GripperFile,
    claw: &'a Claw,
    s: &'a Constraints<'a>,
    /// Direction across the approach.
    across: Vec3,
    rotation: UnitQuaternion<f64>,
}

impl<'a> PlacementSearch<'a> {
    pub(super) fn new(
        handle: &'a BoxHandle,
        overlap: &'a Overlap,
        tree: &'a Bvh<'a>,
        gripper: &'a GripperFile,
        claw: &'a Claw,
        s: &'a Constraints<'a>,
    ) -> Self {
        let across = handle.approach.cross(&handle.closing);
        let axes = Matrix3::from_columns(&[handle.closing, across, handle.approach]);
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
        Self { handle, overlap, tree, gripper, claw, s, across, rotation }
    }

    /// The pose whose origin has these coordinates from the overlap's origin: across the approach, along the approach,
    /// along the closing direction, metres. `turned` adds half a turn about the approach.
    fn pose(&self, side: f64, depth: f64, off: f64, turned: bool) -> Pose {
        let at = self.overlap.origin + self.across * side + self.handle.approach * depth + self.handle.closing * off;
        let half = UnitQuaternion::from_axis_angle(&Vec3::z_axis(), if turned { PI } else { 0.0 });
        Pose::from_parts(at.into(), self.rotation * half)
    }

    /// The pose at the centre of the overlap, for a handle that fails before any placement is tested.
    pub(super) fn middle(&self) -> Pose {
        self.pose(0.0, 0.0, 0.0, false)
    }

    /// Calls `take` with the collision-free placements until it returns true. Placements with the best contact come
    /// first: near the centre before near the ends, deep before shallow. The slice has up to two placements, half a
    /// turn apart.
    ///
    /// # Errors
    /// No placement is free of collisions: the reason, the best contact and the pose at which the last test failed.
    pub(super) fn find(&self, take: &mut dyn FnMut(&[Placement]) -> bool) -> Result<(), Failed> {
        let cells = self.cells();
        self.check_width(&cells)?;
        let (coarse, fine) = self.sides(&cells);
        let mut failed: Option<Failed> = None;
        let mut most = 0.0f64;
        let mut any = false;
        let count = coarse.len();
        for (k, side) in coarse.into_iter().chain(fine).enumerate() {
            if any && k >= count {
                break;
            }
            let mut strip: Vec<Cell> = cells
                .iter()
                .filter(|c| (c.side - side).abs() <= self.claw.half_width.max(0.5 * self.overlap.cell))
                .copied()
                .collect();
            strip.sort_by(|a, b| a.depth.total_cmp(&b.depth));
            let mut found = Vec::new();
            for turned in [false, true] {
                match self.deepest(side, &strip, turned, &mut most) {
                    Some(Ok(p)) => found.push(p),
                    Some(Err(e)) if failed.as_ref().is_none_or(|f| rank(&e.0) > rank(&f.0)) => failed = Some(e),
                    _ => {}
                }
            }
            if !found.is_empty() {
                any = true;
                if take(&found) {
                    return Ok(());
                }
            }
        }
        if any {
            return Ok(());
        }
        let required = self.s.contact;
        Err(failed.unwrap_or_else(|| {
            (Rejection::Contact { contact_mm2: most * 1e6, required_mm2: required * 1e6 }, most, self.middle())
        }))
    }

    /// The cells of the overlap in the axes of the handle.
    fn cells(&self) -> Vec<Cell> {
        let o = self.overlap;
        o.along(&self.across)
            .zip(o.along(&self.handle.approach))
            .zip(&o.heights)
            .map(|((side, depth), faces)| Cell { side, depth, faces: *faces })
            .collect()
    }

    /// Refuses a handle that is too wide or too thin for the jaws in every cell.
    fn check_width(&self, cells: &[Cell]) -> Result<(), Failed> {
        let [min, max] = self.gripper.opening;
        let (narrowest, widest) = cells.iter().fold((f64::INFINITY, 0.0f64), |(a, b), c| {
            let w = c.faces[0] - c.faces[1];
            (a.min(w), b.max(w))
        });
        let clearance = 2.0 * self.s.clearance;
        let width = self.handle.width;
        if narrowest + clearance > max + WIDTH_TOLERANCE_M {
            let reason = Rejection::TooWide { width_mm: (width + clearance) * 1e3, max_mm: max * 1e3 };
            return Err((reason, 0.0, self.middle()));
        }
        if widest < min - WIDTH_TOLERANCE_M {
            let reason = Rejection::TooThin { width_mm: width * 1e3, min_mm: min * 1e3 };
            return Err((reason, 0.0, self.middle()));
        }
        Ok(())
    }

    /// Positions across the approach to test, nearest to the centre first: a coarse set with steps of a quarter of a
    /// claw's width, and the positions between them, for handles where no coarse position is free.
    fn sides(&self, cells: &[Cell]) -> (Vec<f64>, Vec<f64>) {
        let n = cells.len().max(1) as f64;
        let middle = cells.iter().map(|c| c.side).sum::<f64>() / n;
        let range = cells.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), c| (a.min(c.side), b.max(c.side)));
        let steps = (2.0 * (range.1 - range.0) / self.claw.half_width.max(self.overlap.cell)).ceil().clamp(8.0, 80.0);
        let at = |k: f64| range.0 + (range.1 - range.0) * k / steps;
        let nearest_first = |mut sides: Vec<f64>| {
            sides.sort_by(|a, b| (a - middle).abs().total_cmp(&(b - middle).abs()));
            sides
        };
        let coarse = nearest_first((0..=steps as usize).map(|k| at(k as f64)).chain([middle]).collect());
        let fine =
            nearest_first((0..steps as usize).flat_map(|k| [0.25, 0.5, 0.75].map(|f| at(k as f64 + f))).collect());
        (coarse, fine)
    }

    /// The deepest free placement on a strip of cells sorted by depth; `None` if the contact is too small at every
    /// depth.
    fn deepest(&self, side: f64, strip: &[Cell], turned: bool, most: &mut f64) -> Option<Result<Placement, Failed>> {
        let half = 0.5 * self.overlap.cell;
        let area = self.overlap.cell * self.overlap.cell;
        let (near, far) = (strip.first()?.depth - half, strip.last()?.depth + half);
        // The palm limits the depth.
        let last = far.min(near + self.claw.length - MIN_PALM_GAP_M);
        let contact =
            |tip: f64| strip.iter().filter(|c| c.depth <= tip && c.depth >= tip - self.claw.pad).count() as f64 * area;
        *most = most.max(contact(last));
        // The shallowest tip position whose contact is large enough.
        let needed = (self.s.contact / area - 1e-9).ceil().max(1.0) as usize;
        let first = strip.get(needed - 1)?.depth;
        if !(first <= last + 1e-12) || contact(first) < self.s.contact - 1e-12 {
            return None;
        }
        let at = |tip: f64| self.at(side, tip, strip, turned, contact(tip));
        let held = |p: &Result<Placement, Failed>| p.as_ref().is_ok_and(|p| p.contact >= self.s.contact - 1e-12);
        let deep = at(last);
        if held(&deep) {
            return Some(deep);
        }
        let mut best = at(first);
        if !held(&best) {
            return Some(best);
        }
        let (mut lo, mut hi) = (first, last);
        for _ in 0..HALVINGS {
            let tip = 0.5 * (lo + hi);
            let p = at(tip);
            if held(&p) {
                (best, lo) = (p, tip);
            } else {
                hi = tip;
            }
        }
        // An obstacle limits the depth: keep the clearance from it too, if the contact remains large enough.
        let back = at((lo - self.s.clearance).max(first));
        Some(if held(&back) { back } else { best })
    }

    /// The placement with the tips at a depth, if it is free of collisions there and along the approach.
    fn at(&self, side: f64, tip: f64, strip: &[Cell], turned: bool, contact: f64) -> Result<Placement, Failed> {
        let under = strip.iter().filter(|c| c.depth <= tip && c.depth >= tip - self.claw.pad);
        let (top, bottom) =
            under.fold((f64::NEG_INFINITY, f64::INFINITY), |(a, b), c| (a.max(c.faces[0]), b.min(c.faces[1])));
        let origin = if turned { side + self.claw.middle } else { side - self.claw.middle };
        let pose = self.pose(origin, tip - self.claw.tip, 0.5 * (top + bottom), turned);
        let width = top - bottom;
        let [min, max] = self.gripper.opening;
        let opening = width + 2.0 * self.s.clearance;
        let fail = |reason: Rejection| Err((reason, contact, pose));
        if !(opening <= max + WIDTH_TOLERANCE_M) {
            return fail(Rejection::TooWide { width_mm: opening * 1e3, max_mm: max * 1e3 });
        }
        if width < min - WIDTH_TOLERANCE_M {
            return fail(Rejection::TooThin { width_mm: width * 1e3, min_mm: min * 1e3 });
        }
        match collision(self.tree, self.gripper, [opening, width], &pose, self.s) {
            Some(what) => fail(Rejection::Collides { what }),
            None => Ok(Placement { pose, opening: opening.min(max), contact }),
        }
    }
}

/// Of several failures, the one that passed more tests is reported.
fn rank(r: &Rejection) -> u8 {
    match r {
        Rejection::TooWide { .. } | Rejection::TooThin { .. } => 0,
        _ => 1,
    }
}

/// The part of the gripper that collides with the mesh, or comes nearer to it than half the clearance (at most 0.5 mm):
/// at a pose or along the straight approach, with the jaws open to the first width, or at the pose while the fingers
/// close to the second. Widths in metres.
pub(super) fn collision(
    tree: &Bvh<'_>,
    gripper: &GripperFile,
    [opening, width]: [f64; 2],
    pose: &Pose,
    s: &Constraints<'_>,
) -> Option<&'static str> {
    let fingers = gripper.fingers.len();
    let margin = Vec3::repeat((0.5 * s.clearance).clamp(1e-6, 0.5e-3));
    let back = pose.rotation * Vec3::z() * -s.approach_length;
    for (k, b) in gripper.boxes(opening).iter().enumerate() {
        let b = OrientedBox { half: b.half + margin, ..*b }.moved(pose);
        // A box inside the solid touches no triangle.
        if tree.touches_sweep(&b, &back) || tree.encloses(&b.frame_from_box.translation.vector) {
            return Some(if k < fingers { "fingers" } else { "body" });
        }
    }
    let shut = width + 2.0 * CLOSING_GAP_M.min(s.clearance);
    let closing = gripper.boxes(shut).into_iter().take(fingers).any(|b| tree.touches(&b.moved(pose)));
    closing.then_some("closing fingers")
}
