//! The one likelihood by which every model of every set of contours is fitted, judged and compared.
//!
//! The distance of edge point `i` from the predicted outline is
//!
//! ```text
//! r_i(theta, phi) = e_i + B_i a,    e_i ~ N(0, kappa^2 sigma_i^2),    a ~ N(0, s^2),    phi ~ N(0, I)
//! ```
//!
//! `theta` is the shape, `phi` what is unknown of the rig ([`RigError::modes`](crate::offline::correspondence::rig_error::RigError)), and
//! `B a` the part of the edge error that varies smoothly round a contour (blur, shading, a neighbouring edge), as a short Fourier series for
//! each contour. `kappa` and `s` are estimated with the rest, under a prior. Everything is linear at the optimum, so that one normal matrix
//! gives the estimate, the covariance of shape and rig together, chi-squared and the evidence `p(points | model)` by Laplace's method.
//! Derived in `docs/PAPER.md`, "One likelihood".

use crate::offline::bar::torus::{Torus, rays};
use crate::offline::conic::robust::median;
use crate::offline::conic::sampson::distance;
use crate::offline::conic::{image_of_unit_circle, orient};
use crate::offline::correspondence::rig_error::RigError;
use crate::offline::rim::circle::{frame_of, signed_axis};
use crate::offline::rim::cone::{camera_centre, ray};
use crate::offline::rim::model::{EdgePoint, Projection, Rim};
use nalgebra::{DMatrix, DVector, Matrix2, Matrix3, Vector2, Vector3};

/// Waves of smooth edge error round a contour, relative to each other, by number of periods: slow ones move whole outlines and are the rule,
/// quick ones come from shading here and there.
const WAVES: [f64; 7] = [1.0, 1.0, 0.6, 0.4, 0.3, 0.3, 0.3];
/// Columns of a contour's waves: one constant, a cosine and a sine for each period.
const WAVE_COLUMNS: usize = 2 * WAVES.len() - 1;
/// Sizes of the smooth edge error that are compared, pixels.
const WAVE_PX: [f64; 7] = [0.02, 0.035, 0.06, 0.1, 0.18, 0.32, 0.6];
/// Its expected size, pixels, and how far that is off as a natural logarithm: detected edges show 0.03 to 0.15.
const USUAL_WAVE_PX: f64 = 0.07;
const WAVE_SPREAD: f64 = 0.7;
/// A size of the waves that lets none through, pixels.
const NO_WAVE_PX: f64 = 0.003;
/// Strength of the belief that points scatter as they say (`kappa = 1`), in points.
const NOISE_BELIEF: f64 = 6.0;
/// A point farther from the outline than this, in its own standard deviations, is somebody else's and costs as much.
pub(in crate::offline) const OUTLIER_SIGMAS: f64 = 4.5;
/// Gauss-Newton rounds at most, and the step, in standard deviations of the answer, from which it has converged.
const ROUNDS: usize = 14;
const CONVERGED: f64 = 0.05;
/// Usual radius of a bar as a fraction of its ring's, and how far bars differ from it, as a natural logarithm: hand wheels, handles and pipes lie
/// between a thirtieth and a half.
const USUAL_BAR: f64 = 0.12;
const BAR_SPREAD: f64 = 0.6;
/// How far the second edge of a flat ring lies from coaxial with the first: across and along the axis as a fraction of the radius, and in direction,
/// radians.
const COAXIAL: [f64; 3] = [0.005, 0.05, 0.005];
/// How far the radius of the second edge differs from the first, as a fraction of it: what a bar's diameter may be.
const RING_WIDTH: f64 = 0.15;
/// Parameters of a shape at most.
const SHAPE: usize = 8;

/// What a set of contours is a picture of.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::offline) enum Shape {
    /// A plane circle.
    Circle(Rim),
    /// A plane ellipse, and how far it is from round: standard deviation of its unevenness as a fraction of its size.
    Ellipse(Rim, f64),
    /// A round bar; and where somebody said it, its radius with the relative uncertainty of that. The fitted parameter is the radius' logarithm.
    Bar(Torus, Option<(f64, f64)>),
}

/// One contour's edge points.
#[derive(Clone, Debug)]
pub(in crate::offline) struct Stretch {
    /// View, 0 or 1.
    pub(in crate::offline) view: usize,
    /// The points.
    pub(in crate::offline) points: Vec<EdgePoint>,
    /// Place of each round the contour, radians.
    pub(in crate::offline) place: Vec<f64>,
    /// Which of the shapes it belongs to.
    pub(in crate::offline) shape: usize,
}

/// A model at its optimum.
#[derive(Clone, Debug)]
pub(in crate::offline) struct Fitted {
    /// The shapes.
    pub(in crate::offline) shapes: Vec<Shape>,
    /// Logarithm of the evidence, up to a constant of the points.
    pub(in crate::offline) log_evidence: f64,
    /// Squared residuals in their own covariance, priors included: chi-squared with about `dof` degrees of freedom for a right model.
    pub(in crate::offline) chi2: f64,
    /// Degrees of freedom.
    pub(in crate::offline) dof: f64,
    /// Noise of the points in units of their own sigmas.
    pub(in crate::offline) kappa: f64,
    /// Size of the smooth edge error, pixels.
    pub(in crate::offline) wave_px: f64,
    /// Expected rig error in units of the modes.
    pub(in crate::offline) phi: DVector<f64>,
    /// Covariance of the first shape (centre, normal in `frame_of`, shape; natural units) and of the rig's modes after it.
    pub(in crate::offline) cov: DMatrix<f64>,
    /// Number of the first shape's parameters.
    pub(in crate::offline) parameters: usize,
    /// Residual of each point with the estimated rig error put right, pixels, and whether it was used; in the stretches' order.
    pub(in crate::offline) residuals: Vec<(f64, bool)>,
}

impl Shape {
    fn parameters(&self) -> usize {
        match self {
            Self::Circle(_) => 6,
            Self::Ellipse(..) => 8,
            Self::Bar(..) => 7,
        }
    }

    fn centre(&self) -> Vector3<f64> {
        match self {
            Self::Circle(r) | Self::Ellipse(r, _) => r.centre,
            Self::Bar(t, _) => t.centre,
        }
    }

    fn normal(&self) -> Vector3<f64> {
        match self {
            Self::Circle(r) | Self::Ellipse(r, _) => r.normal,
            Self::Bar(t, _) => t.normal,
        }
    }

    fn size(&self) -> f64 {
        match self {
            Self::Circle(r) | Self::Ellipse(r, _) => r.a,
            Self::Bar(t, _) => t.core,
        }
    }

    /// Standard deviation of each parameter before anything is seen, natural units, and how far the present value is from the prior's mean
    /// in them. Place and direction are as good as free; what tells models from each other is how far an ellipse is from round and how thick
    /// a bar is.
    fn prior(&self) -> ([f64; SHAPE], [f64; SHAPE]) {
        let (reach, size) = (self.centre().norm(), self.size());
        let mut sd = [reach, reach, reach, 1.0, 1.0, 0.5 * size, 0.0, 0.0];
        let mut off = [0.0; SHAPE];
        match self {
            Self::Circle(_) => {}
            Self::Ellipse(r, uneven) => {
                let s = shape_matrix(r);
                (sd[6], sd[7]) = (uneven * size, uneven * size);
                off[6] = 0.5 * (s[(0, 0)] - s[(1, 1)]) / sd[6];
                off[7] = s[(0, 1)] / sd[7];
            }
            Self::Bar(t, known) => {
                let (mean, spread) = known.unwrap_or((USUAL_BAR * size, BAR_SPREAD));
                sd[6] = spread;
                off[6] = (t.bar / mean).ln() / spread;
            }
        }
        (sd, off)
    }

    /// The shape moved by natural parameters: centre, normal turned towards `frame_of`'s axes, radius (and its unevenness along and between
    /// those axes), or core and bar radius.
    fn moved(&self, d: &[f64; SHAPE]) -> Option<Self> {
        let f = frame_of(&self.normal());
        let normal = (self.normal() + f.column(0) * d[3] + f.column(1) * d[4]).try_normalize(0.1)?;
        let centre = self.centre() + Vector3::new(d[0], d[1], d[2]);
        let plane = |s: Matrix2<f64>| -> Option<Rim> {
            let g = turned_frame(&f, &normal)?;
            rim_of(centre, normal, &g, &s)
        };
        Some(match self {
            Self::Circle(r) => Self::Circle(plane(Matrix2::identity() * (r.a + d[5]))?),
            Self::Ellipse(r, uneven) => {
                let s = shape_matrix(r) + Matrix2::new(d[5] + d[6], d[7], d[7], d[5] - d[6]);
                Self::Ellipse(plane(s)?, *uneven)
            }
            Self::Bar(t, known) => {
                let torus = Torus { centre, normal, core: t.core + d[5], bar: t.bar * d[6].clamp(-1.0, 1.0).exp() };
                if !(torus.bar > 0.0 && torus.bar < 0.95 * torus.core) {
                    return None;
                }
                Self::Bar(torus, *known)
            }
        })
    }

    /// Natural parameters that lead from this shape to another of its kind, near it.
    fn difference(&self, to: &Self) -> [f64; SHAPE] {
        let f = frame_of(&self.normal());
        let (c, n) = (to.centre() - self.centre(), to.normal() - self.normal());
        let mut d = [c.x, c.y, c.z, f.column(0).dot(&n), f.column(1).dot(&n), to.size() - self.size(), 0.0, 0.0];
        match (self, to) {
            (Self::Ellipse(a, _), Self::Ellipse(b, _)) => {
                let s = shape_matrix(b) - shape_matrix(a);
                (d[5], d[6], d[7]) = (0.5 * (s[(0, 0)] + s[(1, 1)]), 0.5 * (s[(0, 0)] - s[(1, 1)]), s[(0, 1)]);
            }
            (Self::Bar(a, _), Self::Bar(b, _)) => d[6] = (b.bar / a.bar).ln(),
            _ => {}
        }
        d
    }

    /// Distance of points of a view from the shape's outline there, pixels.
    fn residuals(&self, points: &[EdgePoint], p: &Projection, out: &mut Vec<f64>) -> Option<()> {
        match self {
            Self::Circle(r) | Self::Ellipse(r, _) => {
                let conic = rim_conic(p, r);
                out.extend(points.iter().map(|q| distance(&conic, &q.uv)));
            }
            Self::Bar(t, _) => out.extend(rays(points, p)?.iter().map(|ray| t.residual(ray))),
        }
        Some(())
    }
}

/// The frame of a plane carried along when its normal turns.
fn turned_frame(f: &Matrix3<f64>, normal: &Vector3<f64>) -> Option<[Vector3<f64>; 2]> {
    let e1 = f.column(0).into_owned();
    let e1 = (e1 - normal * normal.dot(&e1)).try_normalize(1e-6)?;
    Some([e1, normal.cross(&e1)])
}

/// Symmetric matrix of a rim's semi-axes in the axes of `frame_of` its normal.
fn shape_matrix(r: &Rim) -> Matrix2<f64> {
    let f = frame_of(&r.normal);
    let a = Vector2::new(r.axis_a.dot(&f.column(0)), r.axis_a.dot(&f.column(1)));
    let b = Vector2::new(-a.y, a.x);
    (a * a.transpose() * r.a + b * b.transpose() * r.b) / a.norm_squared().max(1e-12)
}

fn rim_of(centre: Vector3<f64>, normal: Vector3<f64>, g: &[Vector3<f64>; 2], s: &Matrix2<f64>) -> Option<Rim> {
    let eigen = s.symmetric_eigen();
    let (big, small) = if eigen.eigenvalues[0] >= eigen.eigenvalues[1] { (0, 1) } else { (1, 0) };
    let v = eigen.eigenvectors.column(big);
    let axis_a = signed_axis(g[0] * v[0] + g[1] * v[1]);
    let (a, b) = (eigen.eigenvalues[big], eigen.eigenvalues[small]);
    (b > 0.0 && a.is_finite()).then(|| Rim { centre, normal, a, b, axis_a, axis_b: normal.cross(&axis_a) })
}

fn rim_conic(p: &Projection, r: &Rim) -> Matrix3<f64> {
    let m = p.fixed_view::<3, 3>(0, 0);
    let h = Matrix3::from_columns(&[m * r.axis_a * r.a, m * r.axis_b * r.b, m * r.centre + p.column(3)]);
    orient(&image_of_unit_circle(&(h / h.norm())))
}

/// A hypothesis about some contours: shapes, and whether the right contour is another one than the left.
#[derive(Clone, Debug)]
pub(in crate::offline) struct Hypothesis {
    /// The shapes that the stretches belong to.
    pub(in crate::offline) shapes: Vec<Shape>,
    /// Standard deviation, pixels, of how far a contour of the right image lies from where the left one's shape puts it, across and in height
    /// over the epipolar lines. `None` if both are pictures of one shape.
    pub(in crate::offline) unrelated_px: Option<f64>,
}

/// Columns of the linear model, at one state.
struct Linear {
    /// A row a point: shapes, rig, displacement of unrelated contours, waves.
    columns: DMatrix<f64>,
    residual: Vec<f64>,
    sigma: Vec<f64>,
    /// Unit of each column's parameter, and the present value in it. Waves have no unit here.
    unit: Vec<f64>,
    offset: Vec<f64>,
    /// Units of a second shape's place and direction, relative to the first.
    coaxial: [f64; 5],
    /// First column of the rig and of the waves.
    rig: usize,
    waves: usize,
}

/// Sums of the linear model over the points that are used.
struct Sums {
    normal: DMatrix<f64>,
    gradient: DVector<f64>,
    square: f64,
    used: usize,
    count: usize,
}

/// Solution of the linear model for one size of the noise.
struct Solved {
    step: DVector<f64>,
    inverse: DMatrix<f64>,
    chi2: f64,
    log_evidence: f64,
    kappa: f64,
    wave_px: f64,
}

/// Part of each contour that a model has to explain: the rest is hidden or somebody else's.
const EXPLAINED: f64 = 0.5;

fn explains(stretches: &[Stretch], used: &[bool]) -> bool {
    let mut next = used.iter();
    stretches.iter().all(|s| {
        let kept = next.by_ref().take(s.points.len()).filter(|u| **u).count();
        kept as f64 >= EXPLAINED * s.points.len() as f64
    })
}

impl Solved {
    /// Size of the step of shapes and rig in standard deviations.
    fn size(&self, waves: usize) -> f64 {
        (0..waves).map(|k| self.step[k].abs() / self.inverse[(k, k)].sqrt()).fold(0.0, f64::max)
    }
}

/// Fits a hypothesis to contours. `None` where it leads nowhere (a shape collapses, a point has no residual).
///
/// A rig is either as the images of the pair show it, or it has an error of the size that they leave open; both are as likely beforehand. The
/// evidence is that of the mixture. Where the contours do not ask for an error, the estimate is that of the rig as it is shown: an error that is not
/// there would only let the noise of the edges into directions that a good rig determines better. The covariance is that of the unknown rig,
/// taken about the estimate.
pub(in crate::offline) fn fit(hypothesis: &Hypothesis, stretches: &[Stretch], rig: &RigError) -> Option<Fitted> {
    let free = fit_rig(hypothesis, stretches, rig)?;
    if rig.modes.is_empty() {
        return Some(free);
    }
    let start = Hypothesis { shapes: free.shapes.clone(), ..hypothesis.clone() };
    let Some(believed) = fit_rig(&start, stretches, &rig.believed()) else { return Some(free) };
    let (a, b) = (free.log_evidence, believed.log_evidence);
    let log_evidence = a.max(b) + (1.0 + (-(a - b).abs()).exp()).ln() - std::f64::consts::LN_2;
    if a >= b {
        return Some(Fitted { log_evidence, ..free });
    }
    let by_shape = free.shapes.first()?.difference(believed.shapes.first()?);
    let apart = by_shape.into_iter().take(free.parameters).chain(free.phi.iter().map(|v| -v));
    let apart = DVector::from_iterator(free.cov.nrows(), apart);
    Some(Fitted {
        cov: free.cov + &apart * apart.transpose(),
        phi: DVector::zeros(rig.modes.len()),
        log_evidence,
        ..believed
    })
}

fn fit_rig(hypothesis: &Hypothesis, stretches: &[Stretch], rig: &RigError) -> Option<Fitted> {
    let mut shapes = hypothesis.shapes.clone();
    let mut phi = DVector::<f64>::zeros(rig.modes.len());
    let mut noise = (1.0, USUAL_WAVE_PX);
    for round in 0..ROUNDS {
        let linear = Linear::new(hypothesis, &shapes, &phi, stretches, rig)?;
        let used = linear.used(noise, round);
        let sums = linear.sums(&used);
        // The estimate is least squares without the waves; what they would move it by goes into its covariance. On real edges, which have more to them
        // than a few waves, it is the better of the two.
        let solved = linear.solve(&sums, NO_WAVE_PX, noise.0)?;
        noise = (solved.kappa, USUAL_WAVE_PX);
        // Directions that hardly anything determines may creep on; the last round's answer is as good as the next one's.
        if round + 1 == ROUNDS || round >= 2 && solved.size(linear.waves) < CONVERGED {
            if !explains(stretches, &used) {
                return None;
            }
            let best = linear.best_noise(&sums, solved.kappa)?;
            return Some(linear.result(shapes, phi, &best, &sums, &used));
        }
        linear.advance(&mut shapes, &solved.step)?;
        for (k, v) in phi.iter_mut().enumerate() {
            *v += solved.step[linear.rig + k];
        }
    }
    None
}

impl Linear {
    fn new(
        hypothesis: &Hypothesis,
        shapes: &[Shape],
        phi: &DVector<f64>,
        stretches: &[Stretch],
        rig: &RigError,
    ) -> Option<Self> {
        let count: usize = stretches.iter().map(|s| s.points.len()).sum();
        let by_shape: usize = shapes.iter().map(Shape::parameters).sum();
        let apart = if hypothesis.unrelated_px.is_some() { 2 * shapes.len() } else { 0 };
        let (first_rig, first_apart) = (by_shape, by_shape + rig.modes.len());
        let waves = first_apart + apart;
        let width = waves + WAVE_COLUMNS * stretches.len();
        let mut out = Self {
            columns: DMatrix::zeros(count, width),
            residual: Vec::with_capacity(count),
            sigma: stretches.iter().flat_map(|s| s.points.iter().map(|q| q.sigma)).collect(),
            unit: vec![1.0; width],
            offset: vec![0.0; width],
            coaxial: [0.0; 5],
            rig: first_rig,
            waves,
        };
        out.offset.iter_mut().skip(first_rig).zip(phi.iter()).for_each(|(o, p)| *o = *p);
        let p = [0, 1].map(|k| corrected(rig, phi, k));
        let mut first = 0;
        for (n, s) in stretches.iter().enumerate() {
            let shape = shapes.get(s.shape)?;
            let camera = p.get(s.view)?;
            let at: usize = shapes.iter().take(s.shape).map(Shape::parameters).sum();
            shape.residuals(&s.points, camera, &mut out.residual)?;
            out.by_shape(shape, s, camera, at, first)?;
            if s.shape > 0 {
                out.coaxial(shapes.first()?, shape, s.points.len(), at, first);
            }
            let normals = normals(shape, &s.points, camera)?;
            out.by_rig(shape, s, camera, rig, &normals, first)?;
            if let Some(px) = hypothesis.unrelated_px.filter(|_| s.view == 1) {
                out.by_displacement(s, &p, &normals, px, first_apart + 2 * s.shape, first)?;
            }
            for (i, t) in s.place.iter().enumerate() {
                for (w, share) in WAVES.iter().enumerate() {
                    let (sin, cos) = (w as f64 * t).sin_cos();
                    let column = waves + n * WAVE_COLUMNS;
                    if w == 0 {
                        out.columns[(first + i, column)] = *share;
                    } else {
                        out.columns[(first + i, column + 2 * w - 1)] = share * cos;
                        out.columns[(first + i, column + 2 * w)] = share * sin;
                    }
                }
            }
            first += s.points.len();
        }
        (out.residual.iter().all(|r| r.is_finite()) && out.columns.iter().all(|c| c.is_finite())).then_some(out)
    }

    /// Central differences by the shape's parameters, in units of the prior.
    fn by_shape(&mut self, shape: &Shape, s: &Stretch, p: &Projection, at: usize, first: usize) -> Option<()> {
        let (sd, off) = shape.prior();
        for k in 0..shape.parameters() {
            let bar = matches!(shape, Shape::Bar(..)) && k == 6;
            let h = if bar {
                1e-4
            } else if matches!(k, 3 | 4) {
                1e-5
            } else {
                1e-5 * shape.size()
            };
            let mut d = [0.0; SHAPE];
            let mut side = |h: f64| -> Option<Vec<f64>> {
                *d.get_mut(k)? = h;
                let mut out = Vec::with_capacity(s.points.len());
                shape.moved(&d)?.residuals(&s.points, p, &mut out)?;
                Some(out)
            };
            let (ahead, behind) = (side(h)?, side(-h)?);
            for (i, (a, b)) in ahead.iter().zip(&behind).enumerate() {
                self.columns[(first + i, at + k)] = (a - b) / (2.0 * h) * sd[k];
            }
            self.unit[at + k] = sd[k];
            self.offset[at + k] = off[k];
        }
        Some(())
    }

    /// The second edge of a ring goes with the first: its own place and direction are those relative to it.
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
            // Centre in the first edge's frame; the normals' frames differ by next to nothing.
            let by_centre = Vector3::new(own[0], own[1], own[2]);
            for (k, sd) in sd.iter().enumerate() {
                let by = if k < 3 { by_centre.dot(&f.column(k)) } else { own[k] };
                self.columns[(i, at + k)] = by * sd;
            }
        }
        self.coaxial = sd;
        // Radius and shape follow the first edge's within the width of a ring.
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

    /// A camera that is off moves the predicted outline; only what moves it along its normal counts.
    fn by_rig(
        &mut self,
        shape: &Shape,
        s: &Stretch,
        p: &Projection,
        rig: &RigError,
        normals: &[Vector2<f64>],
        first: usize,
    ) -> Option<()> {
        let eye = camera_centre(p)?;
        let (centre, normal) = (shape.centre(), shape.normal());
        for (i, (q, n)) in s.points.iter().zip(normals).enumerate() {
            let d = ray(p, q.uv.x, q.uv.y)?;
            let down = normal.dot(&d);
            let reach = if down.abs() > 0.02 { normal.dot(&(centre - eye)) / down } else { d.dot(&(centre - eye)) };
            let x = (eye + d * reach).push(1.0);
            let h = p * x;
            for (j, mode) in rig.modes.iter().enumerate() {
                let m = mode.get(s.view)? * x;
                let moved = Vector2::new(m.x - q.uv.x * m.z, m.y - q.uv.y * m.z) / h.z;
                self.columns[(first + i, self.rig + j)] = -n.dot(&moved);
            }
        }
        Some(())
    }

    /// Another contour than the left one's lies elsewhere across the epipolar lines, and is of another height over them.
    fn by_displacement(
        &mut self,
        s: &Stretch,
        p: &[Projection; 2],
        normals: &[Vector2<f64>],
        px: f64,
        at: usize,
        first: usize,
    ) -> Option<()> {
        let middle = s.points.iter().map(|q| q.uv).sum::<Vector2<f64>>() / s.points.len().max(1) as f64;
        let epipole = p[1] * camera_centre(&p[0])?.push(1.0);
        let line = epipole.cross(&middle.push(1.0));
        let across = Vector2::new(line.x, line.y).try_normalize(0.0)?;
        let spread = s.points.iter().map(|q| across.dot(&(q.uv - middle)).powi(2)).sum::<f64>();
        let spread = (spread / s.points.len().max(1) as f64).sqrt().max(1e-9);
        for (i, (q, n)) in s.points.iter().zip(normals).enumerate() {
            let by = n.dot(&across) * px;
            self.columns[(first + i, at)] = by;
            self.columns[(first + i, at + 1)] = by * across.dot(&(q.uv - middle)) / spread;
        }
        Some(())
    }

    /// Moves the shapes by a step.
    fn advance(&self, shapes: &mut [Shape], step: &DVector<f64>) -> Option<()> {
        let frame = frame_of(&shapes.first()?.normal());
        let (mut at, mut first) = (0, [0.0; SHAPE]);
        for (n, s) in shapes.iter_mut().enumerate() {
            let mut d = [0.0; SHAPE];
            d.iter_mut().enumerate().take(s.parameters()).for_each(|(k, d)| *d = step[at + k] * self.unit[at + k]);
            if n > 0 {
                let own: [f64; 5] = std::array::from_fn(|k| step[at + k] * self.coaxial[k]);
                let place = frame * Vector3::new(own[0], own[1], own[2]);
                for k in 0..3 {
                    d[k] = first[k] + place[k];
                }
                for k in 3..5 {
                    d[k] = first[k] + own[k];
                }
            } else {
                first = d;
            }
            // A step beyond the linear range is cut; the next round goes on from there.
            let far = (d[0].hypot(d[1]).hypot(d[2]) / s.size()).max(d[3].hypot(d[4])).max(d[5].abs() / s.size());
            let cut = if far > 0.3 { 0.3 / far } else { 1.0 };
            at += s.parameters();
            *s = s.moved(&d.map(|x| x * cut))?;
        }
        Some(())
    }

    /// Points that belong to the outline, as far as the present fit can say: the first fit believes the rig and is off as a whole.
    fn used(&self, (kappa, wave_px): (f64, f64), round: usize) -> Vec<bool> {
        let scale = 1.48 * median(self.residual.iter().zip(&self.sigma).map(|(r, s)| (r / s).abs()).collect());
        let scale = if round == 0 { scale.max(1.0) } else { scale.max(kappa) };
        let smooth = 2.0 * wave_px;
        self.residual
            .iter()
            .zip(&self.sigma)
            .map(|(r, s)| r.abs() <= OUTLIER_SIGMAS * (scale * s).hypot(smooth))
            .collect()
    }

    fn sums(&self, used: &[bool]) -> Sums {
        let rows: Vec<usize> = used.iter().enumerate().filter(|(_, u)| **u).map(|(i, _)| i).collect();
        let scaled =
            DMatrix::from_fn(rows.len(), self.columns.ncols(), |i, k| self.columns[(rows[i], k)] / self.sigma[rows[i]]);
        let r = DVector::from_fn(rows.len(), |i, _| self.residual[rows[i]] / self.sigma[rows[i]]);
        Sums {
            normal: scaled.tr_mul(&scaled),
            gradient: scaled.tr_mul(&r),
            square: r.norm_squared(),
            used: rows.len(),
            count: used.len(),
        }
    }

    /// The linear model for a size of the smooth error; the noise of the points is brought to its best value from a start.
    fn solve(&self, sums: &Sums, wave_px: f64, start: f64) -> Option<Solved> {
        let width = self.columns.ncols();
        let weight = |k: usize| if k < self.waves { 1.0 } else { wave_px.powi(-2) };
        let mut kappa = start;
        let mut best = None;
        for _ in 0..2 {
            let k2 = kappa * kappa;
            let mut m = &sums.normal / k2;
            let mut g = &sums.gradient / k2;
            let mut prior = 0.0;
            for k in 0..width {
                m[(k, k)] += weight(k);
                g[k] += weight(k) * self.offset[k];
                prior += weight(k) * self.offset[k] * self.offset[k];
            }
            let factor = m.cholesky()?;
            let log_det = 2.0 * factor.l_dirty().diagonal().iter().map(|v| v.ln()).sum::<f64>();
            let inverse = factor.inverse();
            let step = -(&inverse * &g);
            let chi2 = sums.square / k2 + prior + g.dot(&step);
            let taken = (&inverse * &sums.normal).trace() / k2;
            let data = sums.square + 2.0 * sums.gradient.dot(&step) + step.dot(&(&sums.normal * &step));
            let free = (sums.used as f64 - taken).max(1.0);
            let lost = (sums.count - sums.used) as f64 * OUTLIER_SIGMAS * OUTLIER_SIGMAS;
            let log_prior = -0.5 * ((wave_px / USUAL_WAVE_PX).ln() / WAVE_SPREAD).powi(2)
                - 0.5 * NOISE_BELIEF * (1.0 / k2 - 1.0 + k2.ln());
            let log_waves: f64 = (self.waves..width).map(|_| -wave_px.ln()).sum();
            let log_evidence =
                -0.5 * (chi2 + lost) - 0.5 * log_det + log_waves - sums.count as f64 * kappa.ln() + log_prior;
            best = Some(Solved { step, inverse, chi2, log_evidence, kappa, wave_px });
            let next = ((data.max(0.0) + NOISE_BELIEF) / (free + NOISE_BELIEF)).sqrt();
            if (next / kappa - 1.0).abs() < 0.02 {
                break;
            }
            kappa = next.clamp(0.3, 100.0);
        }
        best
    }

    /// The same for the size of the smooth error that explains the points best: uphill from the usual one, since the evidence has one maximum.
    fn best_noise(&self, sums: &Sums, kappa: f64) -> Option<Solved> {
        let usual = WAVE_PX.iter().position(|w| *w >= USUAL_WAVE_PX)?;
        let mut best = self.solve(sums, *WAVE_PX.get(usual)?, kappa)?;
        for up in [true, false] {
            let mut at = usual;
            while let Some(next) = if up { Some(at + 1) } else { at.checked_sub(1) }.filter(|k| *k < WAVE_PX.len()) {
                let there = self.solve(sums, *WAVE_PX.get(next)?, best.kappa)?;
                if there.log_evidence <= best.log_evidence {
                    break;
                }
                (at, best) = (next, there);
            }
            if at != usual {
                break;
            }
        }
        Some(best)
    }

    fn result(&self, shapes: Vec<Shape>, phi: DVector<f64>, solved: &Solved, sums: &Sums, used: &[bool]) -> Fitted {
        let parameters = shapes.first().map_or(0, Shape::parameters);
        let modes = phi.len();
        let pick: Vec<usize> = (0..parameters).chain(self.rig..self.rig + modes).collect();
        let cov = DMatrix::from_fn(pick.len(), pick.len(), |i, j| {
            let about = solved.inverse[(pick[i], pick[j])] + solved.step[pick[i]] * solved.step[pick[j]];
            about * self.unit[pick[i]] * self.unit[pick[j]]
        });
        Fitted {
            shapes,
            log_evidence: solved.log_evidence,
            chi2: solved.chi2,
            dof: (sums.used as f64 - parameters as f64).max(1.0),
            kappa: solved.kappa,
            wave_px: solved.wave_px,
            phi,
            cov,
            parameters,
            residuals: self.residual.iter().copied().zip(used.iter().copied()).collect(),
        }
    }
}

/// A view's projection with the expected error of the modes put right.
pub(in crate::offline) fn corrected(rig: &RigError, phi: &DVector<f64>, view: usize) -> Projection {
    let mut p = rig.p.get(view).copied().unwrap_or_default();
    for (mode, v) in rig.modes.iter().zip(phi.iter()) {
        p += mode.get(view).copied().unwrap_or_default() * *v;
    }
    p
}

/// Direction in which each point's residual grows, per pixel.
fn normals(shape: &Shape, points: &[EdgePoint], p: &Projection) -> Option<Vec<Vector2<f64>>> {
    const STEP: f64 = 0.01;
    let side = |by: Vector2<f64>| -> Option<Vec<f64>> {
        let moved: Vec<EdgePoint> = points.iter().map(|q| EdgePoint { uv: q.uv + by, ..*q }).collect();
        let mut out = Vec::with_capacity(points.len());
        shape.residuals(&moved, p, &mut out)?;
        Some(out)
    };
    let (right, left) = (side(Vector2::new(STEP, 0.0))?, side(Vector2::new(-STEP, 0.0))?);
    let (down, up) = (side(Vector2::new(0.0, STEP))?, side(Vector2::new(0.0, -STEP))?);
    let pairs = right.iter().zip(&left).zip(down.iter().zip(&up));
    Some(pairs.map(|((r, l), (d, u))| Vector2::new(r - l, d - u) / (2.0 * STEP)).collect())
}
