//! The linear model of all edge points at one state: derivatives of each residual by the shapes, the rig and the
//! displacement of unrelated contours.

use super::model::{Hypothesis, OUTLIER_SIGMAS, Stretch, USUAL_WAVE_PX, corrected};
use super::shape::{OutlinePoint, PARAMETERS, Shape};
use crate::offline::correspondence::rig_error::RigError;
use crate::offline::rim::circle::frame_of;
use crate::offline::statistics::median;
use crate::offline::types::projection::Projection;
use crate::offline::types::projection::camera_centre;
use nalgebra::{DMatrix, DVector, Vector2, Vector3};

/// Standard deviation of the second edge of a flat ring from coaxial with the first: across and along the axis as
/// fractions of the radius, and in direction, radians.
const COAXIAL: [f64; 3] = [0.005, 0.05, 0.005];
/// Standard deviation of the second edge's radius from the first, as a fraction of it: the range of bar diameters.
const RING_WIDTH: f64 = 0.15;

/// Residuals and columns of the linear model, at one state.
pub(super) struct Linear {
    /// One row per point: shapes, rig, displacement of unrelated contours; in units of each parameter's prior.
    pub(super) columns: DMatrix<f64>,
    /// Each point relative to its outline.
    pub(super) points: Vec<OutlinePoint>,
    /// Standard deviation of each point, pixels.
    pub(super) sigma: Vec<f64>,
    /// Prior standard deviation of each column's parameter, and its present value in that unit.
    pub(super) unit: Vec<f64>,
    pub(super) offset: Vec<f64>,
    /// Prior standard deviations of a second shape's position and direction relative to the first.
    coaxial: [f64; 5],
    /// First column of the rig.
    pub(super) rig: usize,
}

impl Linear {
    pub(super) fn new(
        hypothesis: &Hypothesis,
        shapes: &[Shape],
        (phi, displaced): (&DVector<f64>, &[f64]),
        stretches: &[Stretch],
        rig: &RigError,
    ) -> Option<Self> {
        let count: usize = stretches.iter().map(|s| s.points.len()).sum();
        let by_shape: usize = shapes.iter().map(Shape::parameters).sum();
        let (first_rig, first_apart) = (by_shape, by_shape + rig.modes.len());
        let width = first_apart + hypothesis.displacements();
        let mut out = Self {
            columns: DMatrix::zeros(count, width),
            points: Vec::with_capacity(count),
            sigma: stretches.iter().flat_map(|s| s.points.iter().map(|q| q.sigma)).collect(),
            unit: vec![1.0; width],
            offset: vec![0.0; width],
            coaxial: [0.0; 5],
            rig: first_rig,
        };
        out.offset.iter_mut().skip(first_rig).zip(phi.iter().chain(displaced)).for_each(|(o, p)| *o = *p);
        let p = [0, 1].map(|k| corrected(rig, phi, k));
        for s in stretches {
            let shape = shapes.get(s.shape)?;
            let camera = p.get(s.view)?;
            let at: usize = shapes.iter().take(s.shape).map(Shape::parameters).sum();
            let first = out.points.len();
            out.points.extend(shape.outline_points(&s.points, camera)?);
            out.by_shape_and_rig(shape, s.view, camera, rig, at, first);
            if s.shape > 0 {
                out.coaxial(shapes.first()?, shape, s.points.len(), at, first);
            }
            if let Some(px) = hypothesis.unrelated_px.filter(|_| s.view == 1) {
                out.by_displacement(s, &p, px, first_apart + 2 * s.shape, first)?;
            }
        }
        let finite = out.points.iter().all(|r| r.residual.is_finite()) && out.columns.iter().all(|c| c.is_finite());
        finite.then_some(out)
    }

    fn by_shape_and_rig(
        &mut self,
        shape: &Shape,
        view: usize,
        p: &Projection,
        rig: &RigError,
        at: usize,
        first: usize,
    ) {
        let (sd, off) = shape.prior();
        let count = shape.parameters();
        for (own, all) in [(&mut self.unit, &sd), (&mut self.offset, &off)] {
            own.iter_mut().skip(at).zip(all).take(count).for_each(|(o, v)| *o = *v);
        }
        for i in first..self.points.len() {
            let point = self.points[i];
            let motions = shape.motions(&point.foot);
            for k in 0..count {
                self.columns[(i, at + k)] = point.by_motion(&motions[k], p) * sd[k];
            }
            for (j, mode) in rig.modes.iter().enumerate() {
                let change = if view == 0 { &mode[0] } else { &mode[1] };
                self.columns[(i, self.rig + j)] = point.by_camera(change, p);
            }
        }
    }

    /// Expresses the second edge of a ring relative to the first: its position and direction are those relative to it.
    fn coaxial(&mut self, first_shape: &Shape, shape: &Shape, points: usize, at: usize, first: usize) {
        let f = frame_of(&first_shape.normal());
        let [across, along, turn] = COAXIAL;
        let size = first_shape.size();
        let sd = [across * size, across * size, along * size, turn, turn];
        let apart = shape.centre() - first_shape.centre();
        let tipped = shape.normal() - first_shape.normal();
        let off = [
            f.column(0).dot(&apart),
            f.column(1).dot(&apart),
            f.column(2).dot(&apart),
            f.column(0).dot(&tipped),
            f.column(1).dot(&tipped),
        ];
        for i in first..first + points {
            let own: [f64; 5] = std::array::from_fn(|k| self.columns[(i, at + k)] / self.unit[at + k]);
            for (k, o) in own.iter().enumerate() {
                self.columns[(i, k)] = o * self.unit[k];
            }
            // Centre in the first edge's frame; the frames of the two normals nearly coincide.
            let by_centre = Vector3::new(own[0], own[1], own[2]);
            for (k, sd) in sd.iter().enumerate() {
                let by = if k < 3 { by_centre.dot(&f.column(k)) } else { own[k] };
                self.columns[(i, at + k)] = by * sd;
            }
        }
        self.coaxial = sd;
        // The radius follows the first edge's within the width of a ring.
        let narrow = RING_WIDTH * size / self.unit[at + 5];
        if narrow < 1.0 {
            for i in first..first + points {
                self.columns[(i, at + 5)] *= narrow;
            }
            self.unit[at + 5] *= narrow;
        }
        for k in 0..5 {
            self.offset[at + k] = off[k] / sd[k];
        }
    }

    /// An unrelated contour is displaced across the epipolar lines and differs in height over them.
    fn by_displacement(&mut self, s: &Stretch, p: &[Projection; 2], px: f64, at: usize, first: usize) -> Option<()> {
        let middle = s.points.iter().map(|q| q.uv).sum::<Vector2<f64>>() / s.points.len().max(1) as f64;
        let epipole = p[1] * camera_centre(&p[0])?.push(1.0);
        let line = epipole.cross(&middle.push(1.0));
        let across = Vector2::new(line.x, line.y).try_normalize(0.0)?;
        let spread = s.points.iter().map(|q| across.dot(&(q.uv - middle)).powi(2)).sum::<f64>();
        let spread = (spread / s.points.len().max(1) as f64).sqrt().max(1e-9);
        for (i, q) in s.points.iter().enumerate() {
            let by = self.points.get(first + i)?.gradient.dot(&across) * px;
            let taller = by * across.dot(&(q.uv - middle)) / spread;
            self.columns[(first + i, at)] = by;
            self.columns[(first + i, at + 1)] = taller;
            self.points.get_mut(first + i)?.residual += by * self.offset[at] + taller * self.offset[at + 1];
        }
        Some(())
    }

    /// Moves the shapes by a step.
    pub(super) fn advance(&self, shapes: &mut [Shape], step: &DVector<f64>) -> Option<()> {
        let frame = frame_of(&shapes.first()?.normal());
        let (mut at, mut first) = (0, [0.0; PARAMETERS]);
        for (n, s) in shapes.iter_mut().enumerate() {
            let mut d = [0.0; PARAMETERS];
            d.iter_mut().enumerate().take(s.parameters()).for_each(|(k, d)| *d = step[at + k] * self.unit[at + k]);
            if n > 0 {
                let own: [f64; 5] = std::array::from_fn(|k| step[at + k] * self.coaxial[k]);
                let offset = frame * Vector3::new(own[0], own[1], own[2]);
                for k in 0..3 {
                    d[k] = first[k] + offset[k];
                }
                for k in 3..5 {
                    d[k] = first[k] + own[k];
                }
            } else {
                first = d;
            }
            // A step beyond the linear range is shortened; the next iteration continues from there.
            let far = (d[0].hypot(d[1]).hypot(d[2]) / s.size()).max(d[3].hypot(d[4])).max(d[5].abs() / s.size());
            let cut = if far > 0.3 { 0.3 / far } else { 1.0 };
            at += s.parameters();
            *s = s.moved(&d.map(|x| x * cut))?;
        }
        Some(())
    }

    /// The inliers of the present fit. The first fit assumes an exact rig and may be off as a whole.
    pub(super) fn used(&self, kappa: f64, round: usize) -> Vec<bool> {
        let each = || self.points.iter().zip(&self.sigma).map(|(p, s)| (p.residual.abs(), *s));
        let scale = 1.48 * median(each().map(|(r, s)| r / s).collect());
        let scale = if round == 0 { scale.max(1.0) } else { scale.max(kappa) };
        let smooth = 2.0 * USUAL_WAVE_PX;
        each().map(|(r, s)| r <= OUTLIER_SIGMAS * (scale * s).hypot(smooth)).collect()
    }
}
