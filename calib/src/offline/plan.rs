//! The whole off-line stage as one pure function: two images, what was selected in them, a rig and a gripper in; a plan or a reason out.

use crate::files::{
    ConeRecord, EdgeRecord, FileError, GoalRecord, GripperFile, ImageRecord, MarkRecord, ModelRecord, ObjectRecord,
    PathRecord, PlanFile, PoseRecord, RigFile, SeenRig, SelectionRecord, SourceRecord, ViewPair,
};
use crate::offline::contour::select::{self, Candidate, SelectError, Selection};
use crate::offline::contour::{Contour, ViewEdges};
use crate::offline::correspondence::rig_error::{RigError, RigPrior};
use crate::offline::correspondence::spots::{Votes, spots};
use crate::offline::decide::pairing::{self, Pair};
use crate::offline::decide::propose::{Proposal, propose};
use crate::offline::edges::grey_image::GreyImage;
use crate::offline::edges::lens::{Lens, projection};
use crate::offline::handle::grasp::{self, Approach, Grasp, GraspError, object_frame};
use crate::offline::handle::setpoint::{RimObstacle, Scene, fewest_on_the_way};
use crate::offline::rim::model::{self, Reconstruction, RimModel};
use crate::offline::rim::refusal::Refusal;
use graspd_rt::geom::{Pose, Rig, View};
use graspd_rt::setpoint::{Goal, SetPoint};

/// How many contours of a view are tried against the other's.
const CANDIDATES: usize = 5;

/// What to assume, to tolerate and to aim at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlanOptions {
    /// Of the reconstruction. Lengths in metres.
    pub rim: model::Options,
    /// Of the approach.
    pub approach: Approach,
    /// Epipolar displacement that the rig file may have wrong, pixels (one standard deviation); `None` for its stated quality, or the default.
    pub calibration_px: Option<f64>,
}

impl Default for PlanOptions {
    /// A real rig's calibration is good to a fraction of a pixel, and the edges' own noise is a lower bound of the doubt.
    fn default() -> Self {
        Self {
            rim: model::Options { calibration_px: 1.0, edge_bias_px: 0.1, ..model::Options::default() },
            approach: Approach::default(),
            calibration_px: None,
        }
    }
}

impl PlanOptions {
    /// What the rig file may have wrong.
    pub fn prior(&self, rig: &RigFile) -> RigPrior {
        let stated = RigPrior(rig.error());
        self.calibration_px.map_or(stated, |px| stated.displacing(&rig.rig, px))
    }
}

/// A finished off-line stage.
#[derive(Clone, Debug)]
pub struct Plan {
    /// What goes into the plan file.
    pub file: PlanFile,
    /// Its text, the same for the same input.
    pub text: String,
    /// What goes to the loop.
    pub set_point: SetPoint,
    /// The contours used, left and right.
    pub contours: [Contour; 2],
    /// The inner outlines of a round bar, left and right, where they were looked for and found.
    pub inner: [Option<Contour>; 2],
    /// The rim.
    pub reconstruction: Reconstruction,
    /// The grasp.
    pub grasp: Grasp,
}

/// Why there is no plan.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// A file is wrong.
    #[error(transparent)]
    File(#[from] FileError),
    /// An image's size is not the camera's.
    #[error(
        "the {view} image is {width}x{height}, but the rig's {view} camera is {rig_width}x{rig_height}: give the image of that camera, unscaled, or the rig file of this size"
    )]
    ImageSize {
        /// "left" or "right".
        view: &'static str,
        /// Width of the image.
        width: usize,
        /// Height of the image.
        height: usize,
        /// Width in the rig file.
        rig_width: u32,
        /// Height in the rig file.
        rig_height: u32,
    },
    /// A selection leads nowhere.
    #[error(transparent)]
    Select(#[from] SelectError),
    /// The views are swapped.
    #[error(
        "the views are swapped: the contours do not fit one rim as given ({as_given}), but do with left and right exchanged: exchange the two images, or the cameras in the rig file"
    )]
    Swapped {
        /// Why they do not fit as given.
        as_given: Refusal,
    },
    /// The images are exchanged, by everything that is in them.
    #[error(
        "the views are swapped: of the distinct spots of the images {exchanged} lie where the rig wants them with left and right exchanged, {as_given} as given: exchange the two images, or the cameras in the rig file"
    )]
    Exchanged {
        /// Spots that speak for the order as given.
        as_given: usize,
        /// Spots that speak for the other.
        exchanged: usize,
    },
    /// No rim.
    #[error(transparent)]
    Rim(#[from] Refusal),
    /// No grasp.
    #[error(transparent)]
    Grasp(#[from] GraspError),
}

impl PlanError {
    /// A word for machines.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::File(_) => "file",
            Self::ImageSize { .. } => "image-size",
            Self::Select(_) => "selection",
            Self::Swapped { .. } | Self::Exchanged { .. } => "views-swapped",
            Self::Rim(_) => "rim",
            Self::Grasp(_) => "grasp",
        }
    }

    /// Whether the input itself is wrong (as against a rim or a grasp that the tests refuse).
    pub fn is_input(&self) -> bool {
        !matches!(self, Self::Rim(_) | Self::Grasp(_))
    }
}

/// Two images with everything that a plan takes from them whatever is selected, so that several selections cost its making once.
#[derive(Debug)]
pub struct Prepared<'a> {
    pub(super) edges: [ViewEdges<'a>; 2],
    /// The rig as the images have it, and what stays unknown of it.
    pub(super) seen: RigError,
    images: [&'a GreyImage; 2],
    rig: &'a RigFile,
    votes: Votes,
}

impl<'a> Prepared<'a> {
    /// The same for a rig of the quality that its file states.
    pub fn new(images: [&'a GreyImage; 2], rig: &'a RigFile) -> Result<Self, PlanError> {
        Self::with_prior(images, rig, &RigPrior(rig.error()))
    }

    /// Checks the images' sizes, holds the images against the rig file, and finds their edges.
    pub fn with_prior(images: [&'a GreyImage; 2], rig: &'a RigFile, prior: &RigPrior) -> Result<Self, PlanError> {
        for (view, image, name) in [(View::Left, images[0], "left"), (View::Right, images[1], "right")] {
            let c = rig.rig.camera(view);
            if (image.width(), image.height()) != (c.width as usize, c.height as usize) {
                return Err(PlanError::ImageSize {
                    view: name,
                    width: image.width(),
                    height: image.height(),
                    rig_width: c.width,
                    rig_height: c.height,
                });
            }
        }
        let lenses = View::BOTH.map(|v| Lens::new(rig.rig.camera(v)));
        let p = View::BOTH.map(|v| projection(&rig.rig, v));
        let noise = images[0].noise().max(images[1].noise());
        let found = spots(images, [&lenses[0], &lenses[1]], [&p[0], &p[1]], noise);
        let seen = RigError::observe(&rig.rig, prior, &found.matches);
        let edges = View::BOTH.map(|v| ViewEdges::new(images[v.index()], seen.rig.camera(v)));
        Ok(Self { edges, seen, images, rig, votes: found.votes })
    }

    /// How the images' spots vote on their order.
    pub fn order(&self) -> Votes {
        self.votes
    }

    /// How the images and the rig file agree.
    pub fn rig_error(&self) -> &RigError {
        &self.seen
    }

    /// Refuses images in the wrong order.
    fn in_order(&self) -> Result<(), PlanError> {
        let v = self.order();
        if v.are_exchanged() {
            return Err(PlanError::Exchanged { as_given: v.as_given, exchanged: v.exchanged });
        }
        Ok(())
    }

    /// Plans a grasp on the contour that was selected in both images.
    pub fn plan(
        &self,
        selections: [&Selection; 2],
        gripper: &GripperFile,
        options: &PlanOptions,
    ) -> Result<Plan, PlanError> {
        let [l, r] = &self.edges;
        let left = select::contours(View::Left, l, selections[0], CANDIDATES);
        let right = select::contours(View::Right, r, selections[1], CANDIDATES);
        let (left, right) = match (left, right) {
            (Ok(l), Ok(r)) => (l, r),
            (Err(e), _) | (_, Err(e)) => {
                self.in_order()?;
                return Err(self
                    .crossed(selections, options)
                    .map_or(PlanError::Select(e), |as_given| PlanError::Swapped { as_given }));
            }
        };
        let record = selections.map(|s| SelectionRecord {
            kind: s.kind().to_owned(),
            points_px: s.pixels().iter().map(|p| [p.x, p.y]).collect(),
        });
        from_candidates(self, [&left, &right], record, gripper, options).map_err(|e| match e {
            PlanError::Rim(rim) => self
                .crossed(selections, options)
                .map_or(PlanError::Rim(rim), |as_given| PlanError::Swapped { as_given }),
            other => other,
        })
    }

    /// Ellipses proposed without a selection, ranked, at most `most`. `watch` is told what part of the work is done.
    pub fn proposals(
        &self,
        options: &PlanOptions,
        most: usize,
        watch: &mut dyn FnMut(f64),
    ) -> Result<Vec<Proposal>, PlanError> {
        self.in_order()?;
        Ok(propose(&self.edges, [&self.seen.p[0], &self.seen.p[1]], &options.rim, most, watch))
    }

    /// Plans a grasp on a proposal.
    pub fn plan_proposal(
        &self,
        proposal: &Proposal,
        gripper: &GripperFile,
        options: &PlanOptions,
    ) -> Result<Plan, PlanError> {
        let [left, right] = proposal.candidates();
        let record = [0, 1].map(|k| SelectionRecord {
            kind: "auto".to_owned(),
            points_px: proposal.contours[k].points.first().map(|p| [p.raw.x, p.raw.y]).into_iter().collect(),
        });
        from_candidates(self, [&left, &right], record, gripper, options)
    }

    /// Why the contours do not fit as given, where images too plain to tell their order do fit with selections and cameras exchanged.
    fn crossed(&self, selections: [&Selection; 2], options: &PlanOptions) -> Option<Refusal> {
        if self.order().are_as_given() {
            return None;
        }
        let [l, r] = &self.edges;
        let left = select::contours(View::Left, l, selections[1], 2).ok()?;
        let right = select::contours(View::Right, r, selections[0], 2).ok()?;
        pairing::pair([l, r], [&left, &right], &self.seen, &options.rim)
            .err()
            .filter(|u| u.swapped_fits)
            .map(|u| u.refusal)
    }
}

/// Plans a grasp on the contour that was selected in both images.
pub fn plan(
    images: [&GreyImage; 2],
    selections: [&Selection; 2],
    rig: &RigFile,
    gripper: &GripperFile,
    options: &PlanOptions,
) -> Result<Plan, PlanError> {
    Prepared::with_prior(images, rig, &options.prior(rig))?.plan(selections, gripper, options)
}

/// The rest of the stage, from each view's candidate contours.
pub(super) fn from_candidates(
    views: &Prepared<'_>,
    candidates: [&[Candidate]; 2],
    selection: [SelectionRecord; 2],
    gripper: &GripperFile,
    options: &PlanOptions,
) -> Result<Plan, PlanError> {
    // A rim near the middle can be reconstructed either way round; the rest of the images tells.
    views.in_order()?;
    let (images, rig) = (views.images, views.rig);
    let found =
        pairing::pair([&views.edges[0], &views.edges[1]], candidates, &views.seen, &options.rim).map_err(|u| {
            if u.swapped_fits && !views.order().are_as_given() {
                PlanError::Swapped { as_given: u.refusal }
            } else {
                PlanError::Rim(u.refusal)
            }
        })?;
    let Pair { contours, inner, reconstruction, rig: seen, .. } = found;
    let matches = views.seen.seen;
    let grasp = grasp::choose(&seen, gripper, &reconstruction, &options.approach)?;
    let mut plan = assemble((contours, inner), reconstruction, grasp, (rig, &seen), gripper, options);
    plan.file.images = Some(pair_of(images.map(|p| ImageRecord {
        hash: p.hash().to_string(),
        width: p.width() as u32,
        height: p.height() as u32,
    })));
    plan.file.selection = Some(pair_of(selection));
    plan.file.seen_rig = Some(SeenRig::of(&seen, matches.as_given_px, matches.agreeing));
    finish(plan, rig, gripper)
}

fn pair_of<T>([left, right]: [T; 2]) -> ViewPair<T> {
    ViewPair { left, right }
}

/// Writes the text and reads it back as the loop would, so that a plan which `graspd run` would refuse is never handed out.
fn finish(mut plan: Plan, rig: &RigFile, gripper: &GripperFile) -> Result<Plan, PlanError> {
    plan.text = plan.file.to_toml();
    let again = PlanFile::parse(&plan.text, "plan.toml")?;
    plan.set_point = again.set_point(&plan.text, "plan.toml", ("the rig file", rig), ("the gripper file", gripper))?;
    Ok(plan)
}

fn assemble(
    (contours, inner): ([Contour; 2], [Option<Contour>; 2]),
    reconstruction: Reconstruction,
    grasp: Grasp,
    (rig, seen): (&RigFile, &Rig),
    gripper: &GripperFile,
    options: &PlanOptions,
) -> Plan {
    let radius = reconstruction.half_widths().0;
    let rim = reconstruction.rim;
    let obstacle = RimObstacle { centre: rim.centre, normal: rim.normal, radius };
    let opening = grasp.opening.min(gripper.opening[1]);
    let scene = Scene::new(seen, gripper, opening, Some(&obstacle));
    let mut warnings = grasp.warnings.clone();
    let path = options.approach.present.map(|present| {
        let poses = [present, grasp.pregrasp, grasp.grasp];
        let [l, r] = fewest_on_the_way(&scene, &poses, 20);
        if l.0 < grasp::MIN_MARKS && r.0 < grasp::MIN_MARKS {
            warnings.push(format!(
                "on the way from the present pose only {} and {} marks are seen (at {:.0} % and {:.0} % of it): start nearer, or move the rig",
                l.0,
                r.0,
                100.0 * l.1,
                100.0 * r.1
            ));
        }
        let legs = |a: &Pose, b: &Pose| (a.translation.vector - b.translation.vector).norm();
        PathRecord {
            fewest_marks: [l.0, r.0],
            at_fraction: [l.1, r.1],
            turn_deg: present.rotation.angle_to(&grasp.grasp.rotation).to_degrees(),
            length_m: legs(&present, &grasp.pregrasp) + legs(&grasp.pregrasp, &grasp.grasp),
        }
    });
    let goals = [grasp.pregrasp, grasp.grasp].map(|pose| scene.goal(&pose));
    let standoffs = [options.approach.pregrasp_standoff, options.approach.grasp_standoff];
    let file = PlanFile {
        schema: PlanFile::SCHEMA.to_owned(),
        best_view: if grasp.best_view == View::Left { "left" } else { "right" }.to_owned(),
        handle: grasp.handle.to_owned(),
        opening_m: opening,
        flatness: grasp.flatness,
        warnings,
        rig: SourceRecord { name: rig.name.clone(), hash: rig.hash().to_string() },
        gripper: SourceRecord { name: gripper.name.clone(), hash: gripper.hash().to_string() },
        object: object_record(&reconstruction),
        pregrasp: goal_record(&goals[0], standoffs[0]),
        grasp: goal_record(&goals[1], standoffs[1]),
        path,
        images: None,
        selection: None,
        edges: Some(pair_of([0, 1].map(|k| edge_record(&contours[k])))),
        seen_rig: None,
        cones: Some(cone_record(&reconstruction)),
        mesh: None,
        model: model_records(&reconstruction),
        candidate: grasp.candidates.clone(),
    };
    let set_point = SetPoint {
        id: 0,
        pregrasp: goals[0],
        grasp: goals[1],
        object_centre: rim.centre,
        object_normal: rim.normal,
        best_view: grasp.best_view,
    };
    Plan { file, text: String::new(), set_point, contours, inner, reconstruction, grasp }
}

pub(super) fn goal_record(g: &Goal, standoff_m: f64) -> GoalRecord {
    let [left, right] = &g.marks;
    let mark = left
        .iter()
        .zip(right)
        .enumerate()
        .filter(|(_, (l, r))| l.is_some() || r.is_some())
        .map(|(index, (l, r))| MarkRecord { index, left_px: l.map(|p| [p.x, p.y]), right_px: r.map(|p| [p.x, p.y]) })
        .collect();
    GoalRecord { standoff_m, left_from_gripper: PoseRecord::of(&g.left_from_gripper), mark }
}

fn edge_record(c: &Contour) -> EdgeRecord {
    let e = &c.ellipse;
    EdgeRecord {
        points: c.points.len(),
        rejected: c.rejected.len(),
        coverage: c.coverage,
        sigma_px: c.sigma_px(),
        rms_px: c.rms_px,
        ellipse: [e.centre.x, e.centre.y, e.a, e.b, e.theta],
    }
}

/// A model's name as files and people read it.
pub fn model_name(m: RimModel) -> &'static str {
    match m {
        RimModel::Circle => "circle",
        RimModel::Ellipse => "ellipse",
        RimModel::RoundBar => "round bar",
    }
}

fn rows<const R: usize, const C: usize>(m: &nalgebra::SMatrix<f64, R, C>) -> [[f64; C]; R] {
    std::array::from_fn(|i| std::array::from_fn(|j| m[(i, j)]))
}

/// Largest standard deviation over all directions.
pub(super) fn worst<const N: usize>(m: &nalgebra::SMatrix<f64, N, N>) -> f64
where
    nalgebra::Const<N>: nalgebra::DimName,
{
    // The largest eigenvalue of a small symmetric matrix by squaring: exact enough in sixty steps whatever its gap.
    let mut v = nalgebra::SVector::<f64, N>::from_fn(|i, _| 1.0 + 0.1 * i as f64);
    for _ in 0..60 {
        let w = m * v;
        match w.try_normalize(0.0) {
            Some(u) => v = u,
            None => return 0.0,
        }
    }
    v.dot(&(m * v)).max(0.0).sqrt()
}

fn object_record(r: &Reconstruction) -> ObjectRecord {
    let frame = object_frame(r);
    let e = crate::offline::rim::circle::frame_of(&r.rim.normal);
    let x = frame.rotation * nalgebra::Vector3::x();
    let (c, s) = (x.dot(&e.column(0)), x.dot(&e.column(1)));
    let turn = nalgebra::Matrix2::new(c, s, -s, c);
    ObjectRecord {
        model: model_name(r.model).to_owned(),
        centre_m: r.rim.centre.into(),
        normal: r.rim.normal.into(),
        semi_axes_m: [r.rim.a, r.rim.b],
        axis_a: x.into(),
        bar_radius_m: r.bar_radius,
        left_from_object: PoseRecord::of(&frame),
        sigma_centre_mm: worst(&r.cov_centre) * 1e3,
        sigma_normal_deg: worst(&r.cov_normal).to_degrees(),
        covariance_centre_m2: rows(&r.cov_centre),
        covariance_normal_rad2: rows(&(turn * r.cov_normal * turn.transpose())),
        covariance_axes_m2: rows(&r.cov_axes),
        chi2_per_dof: r.report.chi2 / r.report.dof.max(1) as f64,
    }
}

/// A number for a file: what is not finite is written as a very large one, which TOML readers of every language take.
fn finite(v: f64) -> f64 {
    if v.is_finite() { v } else { 1e300 }
}

fn cone_record(r: &Reconstruction) -> ConeRecord {
    let q = &r.report;
    let gap_sigma = [0, 1].map(|k| finite(q.gap_px[k] / q.gap_sigma_px[k].max(1e-12)));
    ConeRecord {
        delta: finite(q.delta),
        gap_px: q.gap_px.map(finite),
        gap_sigma,
        rank2_residue: finite(q.rank2),
        vergence_deg: q.vergence.to_degrees(),
        minor_axis_px: q.minor_axis_px,
    }
}

fn model_records(r: &Reconstruction) -> Vec<ModelRecord> {
    let q = &r.report;
    let best = q.scores.iter().find(|s| s.model == r.model).map_or(0.0, |s| s.bic);
    q.scores
        .iter()
        .map(|s| ModelRecord {
            model: model_name(s.model).to_owned(),
            criterion: finite(s.bic),
            chi2: finite(s.chi2),
            dof: (q.dof + q.scores.iter().find(|t| t.model == r.model).map_or(0, |t| t.parameters))
                .saturating_sub(s.parameters),
            verdict: match (s.model == r.model, s.excluded) {
                (true, _) => "chosen".to_owned(),
                (false, Some(why)) => why.to_owned(),
                (false, None) if s.bic > best => format!("criterion larger by {:.1}", s.bic - best),
                (false, None) => "not asked for".to_owned(),
            },
        })
        .collect()
}
