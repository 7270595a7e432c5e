//! Judges the off-line stage on rendered cells: for every kind of cell, rig error, click and rim option, the answer is
//! compared with ground truth.
//!
//! ```text
//! cargo run --release -p graspd-hil --example judge_cells -- --kinds paint,thin,torus,ellipse --rig-errors 0,0.1:0.02,0.2:0.04,0.5:0.1
//!     --clicks paint,outer,inner --rims auto,edge,round-bar,round-bar+d --first 1 --count 20
//! ```
//!
//! An answer is wrong if ground truth is outside its own 99.9 % region, or if its error exceeds the error floor of the
//! rig by more than 1 mm, 0.5 degrees or (bar radius) 1 mm. The error floor is the error of the maximum-likelihood rim
//! on exact edges with the same rig. "Loop" is the error of a gripper whose servo loop, with the true cameras, has
//! converged on the plan's marks.

#![allow(unreachable_pub)] // modules shared by path with a test

mod cell;
mod judge;
mod reference;
mod table;

use cell::{Cell, Click, Kind, Noise, RigError};
use clap::Parser;
use judge::{Answer, Asked, Outcome, RimAsk, judge};
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

/// Judges the off-line stage on rendered cells
#[derive(Parser)]
struct Args {
    /// Kinds of cells
    #[arg(long, value_delimiter = ',', default_value = "paint,thin,torus,ellipse")]
    kinds: Vec<Kind>,
    /// Errors of the given rig: PERCENT:DEG of focal lengths and relative rotation
    #[arg(long, value_delimiter = ',', value_parser = RigError::parse, default_value = "0,0.1:0.02,0.2:0.04,0.5:0.1")]
    rig_errors: Vec<RigError>,
    /// Where to click
    #[arg(long, value_delimiter = ',', default_value = "paint,outer,inner")]
    clicks: Vec<Click>,
    /// Rim option of the plan
    #[arg(long, value_delimiter = ',', default_value = "auto,edge,round-bar,round-bar+d")]
    rims: Vec<RimAsk>,
    /// First seed
    #[arg(long, default_value_t = 1)]
    first: u64,
    /// Number of seeds
    #[arg(long, default_value_t = 20)]
    count: u64,
    /// Image noise
    #[arg(long, value_enum, default_value = "scene")]
    noise: Noise,
    /// Tolerance of the centre, mm (one sigma)
    #[arg(long, default_value_t = 2.0)]
    tolerance_mm: f64,
    /// Tolerance of the normal, degrees (one sigma)
    #[arg(long, default_value_t = 1.0)]
    tolerance_deg: f64,
    /// Stated calibration error of the rig, pixels [default: that of the planner]
    #[arg(long)]
    calibration_px: Option<f64>,
    /// Cells judged in parallel
    #[arg(long, default_value_t = 2)]
    threads: usize,
    /// Print one line per answer
    #[arg(long)]
    verbose: bool,
    /// Write all answers and the table to this file
    #[arg(long)]
    json: Option<PathBuf>,
    /// Write the images of every cell into this folder
    #[arg(long)]
    images: Option<PathBuf>,
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args = Args::parse();
    let (next, answers) = (AtomicU64::new(0), Mutex::new(Vec::new()));
    let total = args.count * args.kinds.len() as u64;
    std::thread::scope(|s| {
        for _ in 0..args.threads.max(1) {
            s.spawn(|| {
                loop {
                    let k = next.fetch_add(1, Ordering::Relaxed);
                    if k >= total {
                        break;
                    }
                    let kind = args.kinds[(k % args.kinds.len() as u64) as usize];
                    let seed = args.first + k / args.kinds.len() as u64;
                    match one(&args, kind, seed) {
                        Ok(a) => {
                            if args.verbose {
                                a.iter().for_each(|a| println!("{}", line(a)));
                            }
                            answers.lock().unwrap_or_else(|e| e.into_inner()).extend(a);
                        }
                        Err(e) => eprintln!("{kind:?} {seed}: {e}"),
                    }
                }
            });
        }
    });
    let mut answers = answers.into_inner().unwrap_or_else(|e| e.into_inner());
    answers.sort_by_key(|a| (a.kind, a.seed));
    let rows = table::rows(&answers, &args.kinds, &args.rig_errors, &args.clicks, &args.rims);
    print!("{}", table::text(&rows));
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string(&serde_json::json!({ "rows": rows, "answers": answers }))?)?;
    }
    Ok(())
}

fn one(args: &Args, kind: Kind, seed: u64) -> Result<Vec<Answer>, String> {
    let cell = Cell::new(kind, seed, args.noise)?;
    if let Some(folder) = &args.images {
        std::fs::create_dir_all(folder).map_err(|e| format!("{}: {e}", folder.display()))?;
        for (image, view) in cell.images.iter().zip(["left", "right"]) {
            let path = folder.join(format!("{kind:?}-{seed}-{view}.png").to_lowercase());
            let (w, h) = (image.width() as u32, image.height() as u32);
            image::save_buffer(&path, image.data(), w, h, image::ExtendedColorType::L8)
                .map_err(|e| format!("{}: {e}", path.display()))?;
        }
    }
    let asked = Asked {
        tolerance_mm: args.tolerance_mm,
        tolerance_deg: args.tolerance_deg,
        calibration_px: args.calibration_px,
    };
    judge(&cell, &args.rig_errors, &args.clicks, &args.rims, &asked)
}

/// An answer as a line of text.
fn line(a: &Answer) -> String {
    let question = format!("{:?}-{} [{}] {:?} {:?}", a.kind, a.seed, a.rig_error, a.click, a.rim).to_lowercase();
    match &a.outcome {
        Outcome::Refused { kind, text } => format!("{question}: refused {kind}: {text}"),
        Outcome::Planned(m) => format!(
            "{question}: {} {}{}: centre {:.3} mm, normal {:.3} deg; floor {:.3} {:.3}; sigma {:.3} {:.3}; distance {:.1} {:.1} {:.1}; bar {:.2?} mm; loop {:.3?}; chi2 {:.2}; {:.0} ms",
            if m.wrong.is_empty() { "right".to_owned() } else { format!("WRONG ({})", m.wrong.join(", ")) },
            m.model,
            if m.meant { "" } else { ", another rim" },
            m.error[0],
            m.error[1],
            m.floor[0],
            m.floor[1],
            m.sigma[0],
            m.sigma[1],
            m.distance[0],
            m.distance[1],
            m.distance[2],
            m.bar_mm,
            m.loop_error,
            m.chi2_per_dof,
            a.ms
        ),
    }
}
