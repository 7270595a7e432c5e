//! What the HTML reports of rims and meshes share: the page, tables, and the sections with the same values.

use super::plots::{centre_plot, normal_plot};
use crate::files::PathRecord;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use nalgebra::{Matrix2, Matrix3};
use std::fmt::Write as _;

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:72rem;padding:0 1rem;color:#1f2328;background:#fff}\
h1{font-size:1.5rem;margin:0 0 .2rem}h2{font-size:1.05rem;margin:1.6rem 0 .4rem}img{width:100%;border-radius:8px}\
table{border-collapse:collapse;width:100%}td,th{padding:.25rem .6rem;border-bottom:1px solid #d0d7de;text-align:left;vertical-align:top}\
th{font-weight:500;color:#57606a;white-space:nowrap}.two{display:grid;grid-template-columns:1fr 1fr;gap:1.5rem}\
.note{background:#fff8c5;border:1px solid #d4a72c;border-radius:6px;padding:.5rem .8rem;margin:.5rem 0}\
svg{width:100%;height:auto}small{color:#57606a}code{font-size:.85em}\
@media(prefers-color-scheme:dark){body{background:#0d1117;color:#e6edf3}td,th{border-color:#30363d}th,small{color:#8b949e}.note{background:#3a2f0b}}\
@media(max-width:50rem){.two{grid-template-columns:1fr}}";

/// The beginning of a page: title, warnings, and the image (bytes of a PNG file, and its description).
pub(in crate::offline) fn head(
    title: &str,
    set_point: u64,
    warnings: &[String],
    image: Option<(&[u8], &str)>,
) -> String {
    let mut h = String::new();
    // Writing to a String cannot fail.
    let _ = write!(
        h,
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content=\"width=device-width\">\
         <title>graspd plan</title><style>{STYLE}</style><h1>{}</h1><small>set-point <code>{set_point:016x}</code></small>",
        escape(title)
    );
    for w in warnings {
        let _ = write!(h, "<div class=note>{}</div>", escape(w));
    }
    if let Some((png, alt)) = image {
        let _ = write!(h, "<p><img alt=\"{alt}\" src=\"data:image/png;base64,{}\">", STANDARD.encode(png));
    }
    h
}

/// A table row with a name and a value, both HTML.
pub(in crate::offline) fn row(h: &mut String, key: &str, value: &str) {
    let _ = write!(h, "<tr><th>{key}<td>{value}</tr>");
}

/// Escapes text for HTML.
pub(in crate::offline) fn escape(s: &str) -> String {
    s.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// The row of the path from the present pose.
pub(in crate::offline) fn path_row(h: &mut String, path: Option<&PathRecord>) {
    if let Some(p) = path {
        let [left, right] = p.fewest_marks;
        let value = format!(
            "{:.0} mm, rotation {:.0}&deg;; fewest visible marks {left} left, {right} right",
            p.length_m * 1e3,
            p.turn_deg
        );
        row(h, "path", &value);
    }
}

/// The section with the 95 % ellipses of centre and normal; `note` says what they are of. Without a covariance, the
/// reason.
pub(in crate::offline) fn uncertainty(
    h: &mut String,
    note: &str,
    covariance: Result<(Matrix3<f64>, Matrix2<f64>), &str>,
) {
    let _ = write!(h, "<h2>Uncertainty</h2><small>{note}</small><div class=two>");
    let _ = match covariance {
        Ok((centre, normal)) => write!(h, "<div>{}</div><div>{}</div>", centre_plot(&centre), normal_plot(&normal)),
        Err(reason) => write!(h, "<div>{reason}</div>"),
    };
    h.push_str("</div>");
}

/// The cells of a candidate's visibility: solid angles (microsteradians) and numbers of visible marks, left and right.
pub(in crate::offline) fn visibility_cells(usr: [f64; 2], marks: [usize; 2]) -> String {
    format!("<td>{:.1}, {:.1} &micro;sr<td>{}, {}", usr[0], usr[1], marks[0], marks[1])
}
