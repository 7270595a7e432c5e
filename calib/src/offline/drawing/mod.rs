//! Drawings and reports for people: the overlay (paper figure 7) and the one-page report.
//!
//! [`canvas`] draws lines, areas and text. `panel` draws on a view and `sheet` composes panels, legend and values.
//! `page` and `plots` make the HTML page. [`overlay`] and [`report`] are those of a plan on a rim; the ones of a mesh
//! are in [`crate::offline::polyhedral`].

pub mod canvas;
pub mod overlay;
pub(in crate::offline) mod page;
pub(in crate::offline) mod panel;
pub(in crate::offline) mod plots;
pub mod report;
pub(in crate::offline) mod sheet;
