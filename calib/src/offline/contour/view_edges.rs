//! VIEW

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

/// Places at which a trial ellipse is judged at most.
const MOST_PLACES: usize = 160;

/// An image with everything that contours are grown from.
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
    /// Arcs by falling length.
    pub(super) longest: Vec<u32>,
    blur: OnceCell<f64>,
    /// Sines and cosines for walking round trial ellipses.
    pub(super) turns: Turns,
    /// Where edges of which directions are, for trial ellipses.
    pub(super) directions: Directions,
    /// Edges brought to their place, by index: contours that compete share most of theirs.
    refined: RefCell<HashMap<u32, Option<Refined>>>,
    /// Contours with what became of them when their edges were told apart: each is paired with several of the other view.
    pub(super) sharp: RefCell<Vec<(Contour, Sharpened)>>,
}

/// What became of a contour when its edges were told apart from their neighbours.
#[derive(Clone, Debug)]
pub(super) enum Sharpened {
    /// They could be.
    Apart(Contour),
    /// Too few of them could be.
    TooFew,
    /// They scatter by more than they say: root mean square, pixels.
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
        let turns = Turns::new(MOST_PLACES);
        let directions = Directions::new(map.width(), map.height());
        let (refined, sharp) = (RefCell::default(), RefCell::default());
        Self { image, map, arcs, lens, samples, longest, blur: OnceCell::new(), turns, directions, refined, sharp }
    }

    /// An edge point brought to its place (see [`edges::refine`]), once.
    pub(in crate::offline) fn refine(&self, k: u32) -> Option<Refined> {
        if let Some(known) = self.refined.borrow().get(&k) {
            return *known;
        }
        let r = self.map.edges().get(k as usize).and_then(|e| edges::refine(self.image, e, self.map.noise()));
        self.refined.borrow_mut().insert(k, r);
        r
    }

    /// Standard deviation of a sharp edge's image, pixels; measured once.
    pub(in crate::offline) fn blur(&self) -> f64 {
        *self.blur.get_or_init(|| lens_blur(self.image, &self.map))
    }

    /// Whether an edge in reach of a raw pixel may have this direction; see [`Directions::may_have_edge`].
    pub(super) fn may_have_edge(&self, raw: Pixel, towards_bright: Pixel) -> bool {
        self.directions.may_have_edge((&self.map, &self.arcs.ideal), raw, towards_bright)
    }
}
