//! Statistics of the answers: one row for each kind of cell, rig error, click and rim option.

use crate::cell::{Click, Kind, RigError};
use crate::judge::{Answer, CENTRE_95, Measured, NORMAL_95, Outcome, RimAsk};
use serde::Serialize;
use std::collections::BTreeMap;

/// A row.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// Kind of the cells.
    pub kind: Kind,
    /// Error of the given rig.
    pub rig_error: String,
    /// Place of the click.
    pub click: Click,
    /// Rim option.
    pub rim: RimAsk,
    /// Number of questions.
    pub n: usize,
    /// Correct answers with the rim that the click selects.
    pub right: usize,
    /// Correct answers with another rim next to it.
    pub other: usize,
    /// Refused, by kind.
    pub refused: BTreeMap<String, usize>,
    /// Wrong answers.
    pub wrong: usize,
    /// Reasons of the wrong answers: region, centre, normal, bar.
    pub reasons: BTreeMap<String, usize>,
    /// Error of the centre, mm: median, 95 %, largest.
    pub centre_mm: [f64; 3],
    /// Error of the normal, degrees: median, 95 %, largest.
    pub normal_deg: [f64; 3],
    /// Error floor of centre and normal due to the rig: medians.
    pub floor: [f64; 2],
    /// Percentage of answers with ground truth in the 95 % region: centre, normal.
    pub coverage: [f64; 2],
    /// Error of a converged servo loop, mm: median, 95 %.
    pub loop_mm: [f64; 2],
    /// The same, degrees.
    pub loop_deg: [f64; 2],
    /// Processor time, ms: median, 95 %.
    pub ms: [f64; 2],
}

/// The value at a fraction of the sorted values.
pub fn percentile(v: impl IntoIterator<Item = f64>, q: f64) -> f64 {
    let mut v: Vec<f64> = v.into_iter().collect();
    v.sort_by(f64::total_cmp);
    let k = ((v.len() as f64 * q).ceil() as usize).clamp(1, v.len().max(1));
    v.get(k - 1).copied().unwrap_or(f64::NAN)
}

/// Evaluates the answers of one row.
fn row(answers: &[&Answer]) -> Option<Row> {
    let first = answers.first()?;
    let mut refused = BTreeMap::new();
    let mut reasons = BTreeMap::new();
    let mut planned: Vec<&Measured> = Vec::new();
    for a in answers {
        match &a.outcome {
            Outcome::Refused { kind, .. } => *refused.entry(kind.clone()).or_default() += 1,
            Outcome::Planned(m) => {
                m.wrong.iter().for_each(|w| *reasons.entry((*w).to_owned()).or_default() += 1);
                planned.push(m);
            }
        }
    }
    let count = |f: &dyn Fn(&Measured) -> bool| planned.iter().filter(|m| f(m)).count();
    let of = |f: &dyn Fn(&Measured) -> f64, q: f64| percentile(planned.iter().map(|m| f(m)), q);
    let three = |f: &dyn Fn(&Measured) -> f64| [0.5, 0.95, 1.0].map(|q| of(f, q));
    let ended = |k: usize| [0.5, 0.95].map(|q| percentile(planned.iter().filter_map(|m| Some(m.loop_error?[k])), q));
    let percent = |n: usize| 100.0 * n as f64 / planned.len() as f64;
    Some(Row {
        kind: first.kind,
        rig_error: first.rig_error.clone(),
        click: first.click,
        rim: first.rim,
        n: answers.len(),
        right: count(&|m| m.wrong.is_empty() && m.meant),
        other: count(&|m| m.wrong.is_empty() && !m.meant),
        wrong: count(&|m| !m.wrong.is_empty()),
        refused,
        reasons,
        centre_mm: three(&|m| m.error[0]),
        normal_deg: three(&|m| m.error[1]),
        floor: [of(&|m| m.floor[0], 0.5), of(&|m| m.floor[1], 0.5)],
        coverage: [percent(count(&|m| m.distance[0] <= CENTRE_95)), percent(count(&|m| m.distance[1] <= NORMAL_95))],
        loop_mm: ended(0),
        loop_deg: ended(1),
        ms: [0.5, 0.95].map(|q| percentile(answers.iter().map(|a| a.ms), q)),
    })
}

/// All rows in the order of the questions; rows without questions are omitted.
pub fn rows(answers: &[Answer], kinds: &[Kind], errors: &[RigError], clicks: &[Click], rims: &[RimAsk]) -> Vec<Row> {
    let mut out = Vec::new();
    for kind in kinds {
        for error in errors.iter().map(ToString::to_string) {
            for click in clicks {
                for rim in rims {
                    let of_row =
                        |a: &&Answer| (a.kind, a.click, a.rim) == (*kind, *click, *rim) && a.rig_error == error;
                    out.extend(row(&answers.iter().filter(of_row).collect::<Vec<_>>()));
                }
            }
        }
    }
    out
}

fn counted(m: &BTreeMap<String, usize>) -> String {
    m.iter().map(|(k, n)| format!("{k} {n}")).collect::<Vec<_>>().join(", ")
}

/// A figure; a dash for NaN (no answer).
fn figure(x: f64, digits: usize) -> String {
    if x.is_finite() { format!("{x:.digits$}") } else { "-".to_owned() }
}

/// The table in Markdown.
pub fn text(rows: &[Row]) -> String {
    let mut out = String::from(
        "| cells | rig error | click | rim | n | right | other rim | refused | WRONG | centre mm 50/95/100 % | normal deg 50/95/100 % | floor mm, deg | in 95 % region, % | loop mm 50/95 % | loop deg 50/95 % | ms 50/95 % | refusals; reasons |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    for r in rows {
        let [c, n] = [&r.centre_mm, &r.normal_deg].map(|v| v.map(|x| figure(x, 2)).join(" / "));
        let [m, d] = [&r.loop_mm, &r.loop_deg].map(|v| v.map(|x| figure(x, 2)).join(" / "));
        let word = |v: &dyn std::fmt::Debug| format!("{v:?}").to_lowercase();
        let rim = match r.rim {
            RimAsk::Auto => "auto",
            RimAsk::Edge => "edge",
            RimAsk::RoundBar => "round-bar",
            RimAsk::RoundBarOfDiameter => "round-bar+d",
        };
        out += &format!(
            "| {} | {} | {} | {rim} | {} | {} | {} | {} | {} | {c} | {n} | {}, {} | {}, {} | {m} | {d} | {:.0} / {:.0} | {}{}{} |\n",
            word(&r.kind),
            r.rig_error,
            word(&r.click),
            r.n,
            r.right,
            r.other,
            r.refused.values().sum::<usize>(),
            r.wrong,
            figure(r.floor[0], 2),
            figure(r.floor[1], 2),
            figure(r.coverage[0], 0),
            figure(r.coverage[1], 0),
            r.ms[0],
            r.ms[1],
            counted(&r.refused),
            if r.reasons.is_empty() { "" } else { "; " },
            counted(&r.reasons),
        );
    }
    out
}
