//! The edges of one view with the data that growing contours needs.

use crate::offline::contour::directions::Directions;
use crate::offline::contour::one_ellipse::Contour;
use crate::offline::contour::quick_fit::Turns;
use crate::offline::edges::arcs::Arcs;
use crate::offline::edges::grey_image::GreyImage;
use crate::offline::edges::lens::Lens;
use crate::offline::edges::separate::lens_blur;
use crate::offline::edges::{self, EdgeMap, Refined};
use graspd_rt::geom::{Camera, Pixel};
use std::cell::{OnceCell, RefCell};
use std::collections::HashMap;

/// Largest number of points at which a trial ellipse is scored.
const MAX_POINTS: usize = 160;

/// An image with its edge points, arcs and caches for growing contours.
#[derive(Clone, Debug)]
pub struct ViewEdges<'a> {
    /// The image.
    pub image: &'a GreyImage,
    /// Its edge points.
    pub map: EdgeMap,
    /// Their arcs.
    pub arcs: Arcs,
    /// The lens.
    pub lens: Lens,
    /// Up to 16 edges of each arc, evenly spaced.
    pub(super) samples: Vec<Vec<u32>>,
    /// Arc indices, longest first.
    pub(super) longest: Vec<u32>,
    blur: OnceCell<f64>,
    /// Sines and cosines for walking around trial ellipses.
    pub(super) turns: Turns,
    /// Look-up of edge directions near each pixel, for trial ellipses.
    pub(super) directions: Directions,
    /// Refined edges by index: competing contours share most of theirs.
    refined: RefCell<HashMap<u32, Option<Refined>>>,
    /// Contours with the result of separating their edges from neighbours: each contour is paired with several of the
    /// other view.
    pub(super) separations: RefCell<Vec<(Contour, Separation)>>,
}

/// Result of separating a contour's edges from their neighbours.
#[derive(Clone, Debug)]
pub(super) enum Separation {
    /// The contour with separated edges.
    Separated(Contour),
    /// Too few edges could be separated.
    TooFew,
    /// The separated edges scatter by more than their standard deviations: root mean square, pixels.
    Scattered(f64),
}

impl<'a> ViewEdges<'a> {
    /// Detects and links the edges of an image taken by this camera.
    pub fn new(image: &'a GreyImage, camera: &Camera) -> Self {
        let map = EdgeMap::detect(image);
        let lens = Lens::new(camera);
        let arcs = Arcs::link(&map, &lens);
        let samples = arcs
            .arcs
            .iter()
            .map(|a| {
                let step = (a.edges.len() as f64 / 16.0).max(1.0);
                let n = (a.edges.len() as f64 / step) as usize;
                (0..n).filter_map(|k| a.edges.get(((k as f64 + 0.5) * step) as usize).copied()).collect()
            })
            .collect();
        let mut longest: Vec<u32> = (0..arcs.arcs.len() as u32).collect();
        longest.sort_by_key(|k| std::cmp::Reverse(arcs.arcs.get(*k as usize).map_or(0, |a| a.edges.len())));
        let turns = Turns::new(MAX_POINTS);
        let directions = Directions::new(map.width(), map.height());
        let (refined, separations) = (RefCell::default(), RefCell::default());
        Self {
            image,
            map,
            arcs,
            lens,
            samples,
            longest,
            blur: OnceCell::new(),
            turns,
            directions,
            refined,
            separations,
        }
    }

    /// A refined edge point (see [`edges::refine()`]), computed once.
    pub(in crate::offline) fn refine(&self, k: u32) -> Option<Refined> {
        if let Some(known) = self.refined.borrow().get(&k) {
            return *known;
        }
        let r = self.map.edges().get(k as usize).and_then(|e| edges::refine(self.image, e, self.map.noise()));
        self.refined.borrow_mut().insert(k, r);
        r
    }

    /// Standard deviation of a separations edge's image, pixels; measured once.
    pub(in crate::offline) fn blur(&self) -> f64 {
        *self.blur.get_or_init(|| lens_blur(self.image, &self.map))
    }

    /// Whether an edge near a raw pixel may have this direction; see [`Directions::may_have_edge`].
    pub(super) fn may_have_edge(&self, raw: Pixel, towards_bright: Pixel) -> bool {
        self.directions.may_have_edge((&self.map, &self.arcs.ideal), raw, towards_bright)
    }
}
