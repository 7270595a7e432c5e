//! Two images prepared for planning, and the steps from selections to a plan.

use crate::files::{GripperFile, ImageRecord, RigFile, SeenRig, SelectionRecord};
use crate::offline::contour::ViewEdges;
use crate::offline::contour::select::{self, Candidate, Selection};
use crate::offline::correspondence::rig_error::RigError;
use crate::offline::correspondence::rig_prior::RigPrior;
use crate::offline::correspondence::spots::{Votes, spots};
use crate::offline::decide::pairing::{self, Pair};
use crate::offline::decide::propose::{Proposal, propose};
use crate::offline::edges::grey_image::GreyImage;
use crate::offline::edges::lens::{Lens, projection};
use crate::offline::handle::grasp;
use crate::offline::plan::assemble::{Plan, assemble, finish};
use crate::offline::plan::error::PlanError;
use crate::offline::plan::options::PlanOptions;
use crate::offline::plan::records::pair_of;
use crate::offline::rim::refusal::Refusal;
use graspd_rt::geom::View;

/// Largest number of contours per view that are paired.
const MAX_CANDIDATES: usize = 5;

/// Two images with everything that a plan takes from them whatever is selected, so that several selections share its
/// cost.
#[derive(Debug)]
pub struct Prepared<'a> {
    pub(super) edges: [ViewEdges<'a>; 2],
    /// The rig as estimated from the images, with its remaining uncertainty.
    pub(super) rig_error: RigError,
    images: [&'a GreyImage; 2],
    rig: &'a RigFile,
    votes: Votes,
}

impl<'a> Prepared<'a> {
    /// Prepares two images for a rig of the quality that its file states.
    ///
    /// # Errors
    /// [`PlanError::ImageSize`].
    pub fn new(images: [&'a GreyImage; 2], rig: &'a RigFile) -> Result<Self, PlanError> {
        Self::with_prior(images, rig, &RigPrior(rig.error()))
    }

    /// Checks the sizes of the images, estimates the error of the rig file from them, and detects their edges.
    ///
    /// # Errors
    /// [`PlanError::ImageSize`].
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
        let rig_error = RigError::observe(&rig.rig, prior, &found.matches);
        let edges = View::BOTH.map(|v| ViewEdges::new(images[v.index()], rig_error.rig.camera(v)));
        Ok(Self { edges, rig_error, images, rig, votes: found.votes })
    }

    /// Votes of the images' spots on their order.
    pub fn order(&self) -> Votes {
        self.votes
    }

    /// The rig as estimated from the images, with its remaining uncertainty.
    pub fn rig_error(&self) -> &RigError {
        &self.rig_error
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
        let left = select::contours(View::Left, l, selections[0], MAX_CANDIDATES);
        let right = select::contours(View::Right, r, selections[1], MAX_CANDIDATES);
        let (left, right) = match (left, right) {
            (Ok(l), Ok(r)) => (l, r),
            (Err(e), _) | (_, Err(e)) => {
                self.in_order()?;
                return Err(self
                    .swapped(selections, options)
                    .map_or(PlanError::Select(e), |as_given| PlanError::Swapped { as_given }));
            }
        };
        let record = selections.map(|s| SelectionRecord {
            kind: s.kind().to_owned(),
            points_px: s.pixels().iter().map(|p| [p.x, p.y]).collect(),
        });
        from_candidates(self, [&left, &right], record, gripper, options).map_err(|e| match e {
            PlanError::Rim(rim) => self
                .swapped(selections, options)
                .map_or(PlanError::Rim(rim), |as_given| PlanError::Swapped { as_given }),
            other => other,
        })
    }

    /// Rims proposed without a selection, ranked, at most `most`. `watch` receives the completed fraction.
    ///
    /// # Errors
    /// [`PlanError::Exchanged`].
    pub fn proposals(
        &self,
        options: &PlanOptions,
        most: usize,
        watch: &mut dyn FnMut(f64),
    ) -> Result<Vec<Proposal>, PlanError> {
        self.in_order()?;
        Ok(propose(&self.edges, [&self.rig_error.p[0], &self.rig_error.p[1]], &options.rim, most, watch))
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

    /// Why the contours do not fit as given, if the spots do not determine the order of the images and the contours
    /// fit with selections and cameras exchanged.
    fn swapped(&self, selections: [&Selection; 2], options: &PlanOptions) -> Option<Refusal> {
        if self.order().are_as_given() {
            return None;
        }
        let [l, r] = &self.edges;
        let left = select::contours(View::Left, l, selections[1], 2).ok()?;
        let right = select::contours(View::Right, r, selections[0], 2).ok()?;
        pairing::pair([l, r], [&left, &right], &self.rig_error, &options.rim)
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
fn from_candidates(
    views: &Prepared<'_>,
    candidates: [&[Candidate]; 2],
    selection: [SelectionRecord; 2],
    gripper: &GripperFile,
    options: &PlanOptions,
) -> Result<Plan, PlanError> {
    // A rim near the middle can be reconstructed in either order; the rest of the images decides.
    views.in_order()?;
    let (images, rig) = (views.images, views.rig);
    let found =
        pairing::pair([&views.edges[0], &views.edges[1]], candidates, &views.rig_error, &options.rim).map_err(|u| {
            if u.swapped_fits && !views.order().are_as_given() {
                PlanError::Swapped { as_given: u.refusal }
            } else {
                PlanError::Rim(u.refusal)
            }
        })?;
    let Pair { contours, inner, reconstruction, rig: seen, .. } = found;
    let matches = views.rig_error.agreement;
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
