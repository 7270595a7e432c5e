//! What people look at: the overlay (the paper's figure 7) and the one-page report.

pub mod canvas;
pub mod overlay;
pub mod report;
