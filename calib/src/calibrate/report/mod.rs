//! The calibration report, one self-contained HTML page: verdict, figures, residuals, coverage, uncertainty over the
//! image, table of pairs.

mod maps;

use super::rig::Calibration;
use super::rig::score::rms;
use super::target::{Collected, Target};
use std::fmt::Write;

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:72rem;padding:0 1rem;color:#1f2328;background:#fff}\
h1{font-size:1.5rem;margin:0 0 .2rem}h2{font-size:1.05rem;margin:1.6rem 0 .4rem}\
table{border-collapse:collapse;width:100%}td,th{padding:.25rem .6rem;border-bottom:1px solid #d0d7de;text-align:left;vertical-align:top}\
th{font-weight:500;color:#57606a}.two{display:grid;grid-template-columns:1fr 1fr;gap:1.5rem}\
.note{background:#fff8c5;border:1px solid #d4a72c;border-radius:6px;padding:.5rem .8rem;margin:.5rem 0}\
.verdict{background:#ddf4ff;border:1px solid #54aeff;border-radius:6px;padding:.6rem .8rem;font-size:1.05rem}\
svg{width:100%;height:auto;background:#f6f8fa;border:1px solid #d0d7de}small{color:#57606a}\
@media(max-width:50rem){.two{grid-template-columns:1fr}}";

/// Renders the page.
pub fn html(target: &Target, collected: &Collected, k: &Calibration) -> String {
    let mut h = format!(
        "<!doctype html><html lang=en><meta charset=utf-8><title>Rig calibration</title><style>{STYLE}</style>"
    );
    let _ = write!(
        h,
        "<h1>Rig calibration</h1><p><small>{} of {} pairs, {}x{} points {:.2} mm apart</small></p><p class=verdict>{}</p>",
        k.used.len(),
        collected.files,
        target.cols,
        target.rows,
        target.spacing * 1e3,
        escape(&k.verdict.text)
    );
    for w in &k.verdict.warnings {
        let _ = write!(h, "<p class=note>{}</p>", escape(w));
    }
    let _ = write!(h, "<p>{}</p>", escape(&k.next_text()));
    figures(&mut h, k);
    h += "<h2>Residuals, magnified 50 times</h2><div class=two>";
    for v in 0..2 {
        let _ = write!(h, "<div>{}<small>{} image</small></div>", maps::residuals(k, v), side(v));
    }
    h += "</div><h2>Coverage: number of points per image cell</h2><div class=two>";
    for v in 0..2 {
        let _ = write!(h, "<div>{}<small>{} image</small></div>", maps::coverage(k, v), side(v));
    }
    h += "</div><h2>Mark error caused by the calibration alone, and tilt of the target</h2><div class=two>";
    let _ = write!(
        h,
        "<div>{}<small>one standard deviation of the position, mm, over the left image at {:.2} m; blank outside the view of the right camera</small></div>",
        maps::uncertainty(k),
        0.5 * (k.volume.range_m[0] + k.volume.range_m[1])
    );
    let _ = write!(
        h,
        "<div>{}<small>one dot per pair: tilt about the vertical axis to the right, about the horizontal axis down; rings at 15, 30, 45 degrees</small></div></div>",
        maps::tilts(k)
    );
    pairs(&mut h, collected, k);
    h
}

fn figures(h: &mut String, k: &Calibration) {
    let s = &k.holdout.scores;
    let sigma = |i: usize| k.fit.covariance[(i, i)].max(0.0).sqrt();
    *h += "<h2>Figures</h2><table>";
    let mut row = |name: &str, text: String| {
        let _ = write!(h, "<tr><th>{name}<td>{text}");
    };
    for (name, c, at) in [("left camera", &k.fit.state.rig.left, 0), ("right camera", &k.fit.state.rig.right, 12)] {
        row(
            name,
            format!(
                "f {:.3} &plusmn; {:.3}, {:.3} &plusmn; {:.3} px; c {:.3} &plusmn; {:.3}, {:.3} &plusmn; {:.3} px; k1 {:.5} k2 {:.5} p1 {:.6} p2 {:.6} k3 {:.5}",
                c.fx,
                sigma(at),
                c.fy,
                sigma(at + 1),
                c.cx,
                sigma(at + 2),
                c.cy,
                sigma(at + 3),
                c.distortion.k1,
                c.distortion.k2,
                c.distortion.p1,
                c.distortion.p2,
                c.distortion.k3
            ),
        );
    }
    let t = k.fit.state.rig.right_from_left;
    row(
        "relative pose",
        format!(
            "baseline {:.4} mm, rotation {:.4}&deg;",
            t.translation.vector.norm() * 1e3,
            t.rotation.angle().to_degrees()
        ),
    );
    row("held out", s.summary());
    row(
        "reprojection",
        format!("{:.3} px RMS in the fit, {:.3} px held out", k.fit.rms_px(), rms(&k.holdout.reprojection_px)),
    );
    row(
        "mark error",
        format!(
            "{:.3} mm from the covariance, {:.3} mm from the jackknife (one standard deviation); {:.3} px from the epipolar line",
            k.predicted.rms_m * 1e3,
            k.jackknife_m * 1e3,
            k.predicted.epipolar_px
        ),
    );
    let (outliers, all) = k.fit.outliers();
    row(
        "points",
        format!(
            "{all}, of which {outliers} rejected as gross errors; bending of the board {:.3} &plusmn; {:.3} mm",
            k.bending_m[0] * 1e3,
            k.bending_m[1] * 1e3
        ),
    );
    *h += "</table>";
}

fn pairs(h: &mut String, collected: &Collected, k: &Calibration) {
    *h += "<h2>Pairs</h2><table><tr><th>pair<th>residual left, right px RMS<th>held out: epipolar px, squares %<th>distance m, tilt &deg;<th>blur px";
    for (i, p) in k.used.iter().enumerate() {
        let of = |v: usize| rms(&k.fit.residuals[i][v].iter().map(|r| r.r.norm()).collect::<Vec<_>>());
        let s = &k.holdout.per_pair[i];
        let tilt = k.coverage.tilts_deg[i];
        let _ = write!(
            h,
            "<tr><td>{}<td>{:.3}, {:.3}<td>{:.3}, {:.3}<td>{:.3}, {:.0} / {:.0}<td>{:.2}, {:.2}",
            escape(&p.name),
            of(0),
            of(1),
            rms(&s.epipolar_px),
            100.0 * rms(&s.squares),
            k.coverage.distances_m[i],
            tilt[0],
            tilt[1],
            p.blur_px[0],
            p.blur_px[1]
        );
    }
    for l in &k.left_out {
        let _ = write!(h, "<tr><td>{}<td colspan=4>left out: {}", escape(&l.name), escape(&l.reason));
    }
    for (name, reason) in &collected.missing {
        let _ = write!(h, "<tr><td>{}<td colspan=4>not used: {}", escape(name), escape(reason));
    }
    *h += "</table>";
}

fn side(v: usize) -> &'static str {
    if v == 0 { "left" } else { "right" }
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}
