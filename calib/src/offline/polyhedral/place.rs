//! Where on a handle the claws can be set down: beside which stretch of it, how deep, how far open, and what of the gripper would hit the part.

use super::bvh::Bvh;
use super::filter::{Reason, Situation};
use super::handles::{BoxHandle, Overlap};
use crate::files::{GripperFile, OrientedBox};
use graspd_rt::geom::{Pose, Vec3};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion};
use std::f64::consts::PI;

/// The palm stays this far from the part, metres.
const PALM: f64 = 1e-3;
/// Claws that close to this much more than the faces' distance (on each side) must not have met anything else, metres.
const SLACK: f64 = 0.5e-3;
/// Widths that differ by less are equal, metres: a part is 27 mm wide only as single precision goes.
const EQUAL: f64 = 1e-6;
/// Halvings of the range of depths: to a sixtieth of it.
const HALVINGS: usize = 6;

/// What of a gripper matters to a claw's contact, in the gripper frame.
pub(super) struct Claw {
    /// Middle of the pads across the approach (y), metres.
    middle: f64,
    /// Half their width, metres.
    pub(super) half_width: f64,
    /// How far the tips stand beyond the gripper's origin, metres.
    pub(super) tip: f64,
    /// Length of the pads along the approach, metres.
    pad: f64,
    /// Length of the fingers in front of the palm, metres.
    length: f64,
}

impl Claw {
    /// What both fingers can press with: where they are not alike, the part that they have in common.
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

/// A way to set the gripper down on a handle.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    /// Gripper pose in the mesh's frame at the grasp.
    pub(super) pose: Pose,
    /// Opening on the way in, metres.
    pub(super) opening: f64,
    /// Contact of each claw, square metres.
    pub(super) contact: f64,
}

/// One cell of an overlap as the claws meet it.
#[derive(Clone, Copy)]
struct Cell {
    side: f64,
    depth: f64,
    faces: [f64; 2],
}

/// Everything about one handle and one gripper.
pub(super) struct Setting<'a> {
    handle: &'a BoxHandle,
    overlap: &'a Overlap,
    tree: &'a Bvh<'a>,
    gripper: &'a GripperFile,
    claw: &'a Claw,
    s: &'a Situation<'a>,
    /// Direction across the approach.
    across: Vec3,
    rotation: UnitQuaternion<f64>,
}

impl<'a> Setting<'a> {
    pub(super) fn new(
        handle: &'a BoxHandle,
        overlap: &'a Overlap,
        tree: &'a Bvh<'a>,
        gripper: &'a GripperFile,
        claw: &'a Claw,
        s: &'a Situation<'a>,
    ) -> Self {
        let across = handle.approach.cross(&handle.closing);
        let axes = Matrix3::from_columns(&[handle.closing, across, handle.approach]);
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
        Self { handle, overlap, tree, gripper, claw, s, across, rotation }
    }

    /// The pose with the gripper's origin at a place of the overlap (across, along the approach, along the closing direction), metres.
    fn pose(&self, side: f64, depth: f64, off: f64, turned: bool) -> Pose {
        let at = self.overlap.origin + self.across * side + self.handle.approach * depth + self.handle.closing * off;
        let half = UnitQuaternion::from_axis_angle(&Vec3::z_axis(), if turned { PI } else { 0.0 });
        Pose::from_parts(at.into(), self.rotation * half)
    }

    /// The pose at the middle of the overlap, for a handle that fails before any place is looked at.
    pub(super) fn middle(&self) -> Pose {
        self.pose(0.0, 0.0, 0.0, false)
    }

    /// Calls `take` with the places that are free, the best hold first (near the middle before at the ends, deep before shallow), the gripper
    /// one way round and half a turn on, which parallel claws do not mind, until it answers true. Otherwise why no place was free, with the
    /// best contact found, and the pose at which the last test failed.
    pub(super) fn find(&self, take: &mut dyn FnMut(&[Place]) -> bool) -> Result<(), (Reason, f64, Pose)> {
        let o = self.overlap;
        let cells: Vec<Cell> = o
            .along(&self.across)
            .zip(o.along(&self.handle.approach))
            .zip(&o.heights)
            .map(|((side, depth), faces)| Cell { side, depth, faces: *faces })
            .collect();
        let [min, max] = self.gripper.opening;
        let (narrow, wide) = cells.iter().fold((f64::INFINITY, 0.0f64), |(a, b), c| {
            let w = c.faces[0] - c.faces[1];
            (a.min(w), b.max(w))
        });
        let air = 2.0 * self.s.clearance;
        let too_wide = |w: f64| Reason::TooWide { width_mm: (w + air) * 1e3, max_mm: max * 1e3 };
        if narrow + air > max + EQUAL {
            return Err((too_wide(self.handle.width), 0.0, self.middle()));
        }
        if wide < min - EQUAL {
            let reason = Reason::TooThin { width_mm: self.handle.width * 1e3, min_mm: min * 1e3 };
            return Err((reason, 0.0, self.middle()));
        }
        let n = cells.len().max(1) as f64;
        let middle = cells.iter().map(|c| c.side).sum::<f64>() / n;
        let range = cells.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), c| (a.min(c.side), b.max(c.side)));
        // Half of half a claw's width apart first; where nothing is free there, between those, so that hardly any room is stepped over.
        let steps = (2.0 * (range.1 - range.0) / self.claw.half_width.max(o.cell)).ceil().clamp(8.0, 80.0);
        let at = |k: f64| range.0 + (range.1 - range.0) * k / steps;
        let nearest_first = |mut sides: Vec<f64>| {
            sides.sort_by(|a, b| (a - middle).abs().total_cmp(&(b - middle).abs()));
            sides
        };
        let coarse = nearest_first((0..=steps as usize).map(|k| at(k as f64)).chain([middle]).collect());
        let fine =
            nearest_first((0..steps as usize).flat_map(|k| [0.25, 0.5, 0.75].map(|f| at(k as f64 + f))).collect());
        let mut failed: Option<(Reason, f64, Pose)> = None;
        let mut most = 0.0f64;
        let mut any = false;
        let count = coarse.len();
        for (k, side) in coarse.into_iter().chain(fine).enumerate() {
            if any && k >= count {
                break;
            }
            let mut strip: Vec<Cell> = cells
                .iter()
                .filter(|c| (c.side - side).abs() <= self.claw.half_width.max(0.5 * o.cell))
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
        let least = self.s.contact;
        Err(failed.unwrap_or_else(|| {
            (Reason::Contact { contact_mm2: most * 1e6, least_mm2: least * 1e6 }, most, self.middle())
        }))
    }

    /// The deepest free place beside a strip of cells (sorted by depth); `None` where the contact is too small at every depth.
    fn deepest(
        &self,
        side: f64,
        strip: &[Cell],
        turned: bool,
        most: &mut f64,
    ) -> Option<Result<Place, (Reason, f64, Pose)>> {
        let half = 0.5 * self.overlap.cell;
        let area = self.overlap.cell * self.overlap.cell;
        let (near, far) = (strip.first()?.depth - half, strip.last()?.depth + half);
        // The part may stand no further in than the fingers are long.
        let last = far.min(near + self.claw.length - PALM);
        let contact =
            |tip: f64| strip.iter().filter(|c| c.depth <= tip && c.depth >= tip - self.claw.pad).count() as f64 * area;
        *most = most.max(contact(last));
        // The shallowest tip that presses enough: as many cells as it takes.
        let needed = (self.s.contact / area - 1e-9).ceil().max(1.0) as usize;
        let first = strip.get(needed - 1)?.depth;
        if !(first <= last + 1e-12) || contact(first) < self.s.contact - 1e-12 {
            return None;
        }
        let at = |tip: f64| self.at(side, tip, strip, turned, contact(tip));
        let held =
            |p: &Result<Place, (Reason, f64, Pose)>| p.as_ref().is_ok_and(|p| p.contact >= self.s.contact - 1e-12);
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
        // Something stands there: keep from it what is kept from the faces, where the hold allows it.
        let back = at((lo - self.s.clearance).max(first));
        Some(if held(&back) { back } else { best })
    }

    /// The place with the tips at a depth, if nothing is hit there or on the way.
    fn at(
        &self,
        side: f64,
        tip: f64,
        strip: &[Cell],
        turned: bool,
        contact: f64,
    ) -> Result<Place, (Reason, f64, Pose)> {
        let under = strip.iter().filter(|c| c.depth <= tip && c.depth >= tip - self.claw.pad);
        let (top, bottom) =
            under.fold((f64::NEG_INFINITY, f64::INFINITY), |(a, b), c| (a.max(c.faces[0]), b.min(c.faces[1])));
        let origin = if turned { side + self.claw.middle } else { side - self.claw.middle };
        let pose = self.pose(origin, tip - self.claw.tip, 0.5 * (top + bottom), turned);
        let width = top - bottom;
        let [min, max] = self.gripper.opening;
        let opening = width + 2.0 * self.s.clearance;
        let fail = |reason: Reason| Err((reason, contact, pose));
        if !(opening <= max + EQUAL) {
            return fail(Reason::TooWide { width_mm: opening * 1e3, max_mm: max * 1e3 });
        }
        if width < min - EQUAL {
            return fail(Reason::TooThin { width_mm: width * 1e3, min_mm: min * 1e3 });
        }
        match collision(self.tree, self.gripper, [opening, width], &pose, self.s) {
            Some(what) => fail(Reason::Collides { what }),
            None => Ok(Place { pose, opening: opening.min(max), contact }),
        }
    }
}

/// Of several failures the one that came furthest is told.
fn rank(r: &Reason) -> u8 {
    match r {
        Reason::TooWide { .. } | Reason::TooThin { .. } => 0,
        _ => 1,
    }
}

/// What of the gripper hits the mesh, or comes closer to it than half the clearance, at a pose or on the straight way to it with the jaws open to
/// the first width; or, at the pose, what the fingers meet before they are closed to the second.
pub(super) fn collision(
    tree: &Bvh<'_>,
    gripper: &GripperFile,
    [opening, width]: [f64; 2],
    pose: &Pose,
    s: &Situation<'_>,
) -> Option<&'static str> {
    let fingers = gripper.fingers.len();
    let air = Vec3::repeat((0.5 * s.clearance).clamp(1e-6, 0.5e-3));
    let back = pose.rotation * Vec3::z() * -s.approach_length;
    for (k, b) in gripper.boxes(opening).iter().enumerate() {
        let b = OrientedBox { half: b.half + air, ..*b }.moved(pose);
        // Wholly within the solid it touches no triangle.
        if tree.touches_sweep(&b, &back) || tree.encloses(&b.frame_from_box.translation.vector) {
            return Some(if k < fingers { "fingers" } else { "body" });
        }
    }
    let shut = width + 2.0 * SLACK.min(s.clearance);
    let closing = gripper.boxes(shut).into_iter().take(fingers).any(|b| tree.touches(&b.moved(pose)));
    closing.then_some("closing fingers")
}
