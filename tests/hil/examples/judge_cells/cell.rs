//! A cell to be judged on: two images, the true rims in them, places where an operator clicks, and the rig with any error.

use crate::reference::{POINTS, Shape, around};
use graspd_calib::files::GripperFile;
use graspd_calib::offline::edges::grey_image::GreyImage;
use graspd_hil::scenario::{Options, Scenario};
use graspd_hil::scene::{Part, Snapshot};
use graspd_rt::geom::{Pixel, Pose, Rig, Vec3, View};
use image::codecs::jpeg::{JpegDecoder, JpegEncoder};
use image::{DynamicImage, ExtendedColorType};
use nalgebra::Point3;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use std::f64::consts::TAU;

/// How far a hand misses along each axis at most, pixels: what the scenario's own clicks have.
const HAND_PX: f64 = 1.2;
/// To either side of an outline a click needs the bar and what is behind it: as far as the hand may miss.
const CLEAR_PX: f64 = 2.0;
/// A point is hidden by what is nearer to the eye by this much, metres: more than a grazing ray's first touch of the bar.
const NEARER_M: f64 = 1e-3;
/// JPEG quality of the round trip.
const JPEG_QUALITY: u8 = 85;

/// A kind of cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// A painted circle of 75 mm on a bar, 30 % of it hidden.
    Paint,
    /// The same on a thinner bar, whose limb comes next to the paint.
    Thin,
    /// A bare wheel of any size.
    Torus,
    /// A painted ellipse on a board, from a renderer of its own.
    Ellipse,
}

/// Where the operator clicks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Click {
    /// On the painted circle or ellipse.
    Paint,
    /// On the bar's outer silhouette.
    Outer,
    /// On the bar's inner silhouette.
    Inner,
}

/// The noise of the images.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Noise {
    /// The renderers' own: read and photon noise of the scene, 2 grey values for ellipses.
    Scene,
    /// 2.5 grey values everywhere.
    Gaussian,
    /// Variance 1 plus a twentieth of the grey value.
    Poisson,
    /// The renderers' own, then a JPEG round trip at quality 85.
    Jpeg,
}

/// The error of the rig as given: both focal lengths, percent, and the relative rotation, degrees; each with a direction drawn by the seed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RigError {
    /// Of the focal lengths, percent.
    pub focal_percent: f64,
    /// Of the relative rotation, degrees.
    pub rotation_deg: f64,
}

impl RigError {
    /// Reads `0`, `0.5:0.1` or `0.5,0.1`.
    pub fn parse(text: &str) -> Result<Self, String> {
        let bad = || format!("rig error {text:?}: give percent of focal length and degrees of rotation, like 0.5:0.1");
        let (f, r) = text.split_once([':', ',']).unwrap_or((text, "0"));
        let number = |s: &str| s.trim().parse::<f64>().ok().filter(|v| v.is_finite()).ok_or_else(bad);
        let e = Self { focal_percent: number(f)?, rotation_deg: number(r)? };
        if text.contains([':', ',']) || e.focal_percent == 0.0 { Ok(e) } else { Err(bad()) }
    }

    /// As scenario options have it.
    pub fn applied(&self, o: &Options) -> Options {
        Options { focal_error: self.focal_percent / 100.0, rotation_error_deg: self.rotation_deg, ..*o }
    }
}

impl std::fmt::Display for RigError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} %, {} deg", self.focal_percent, self.rotation_deg)
    }
}

/// A rim that is there, and the exact raw pixels of its edges that are seen.
#[derive(Clone, Debug)]
pub struct TrueRim {
    /// The rim.
    pub shape: Shape,
    /// Edge pixels in each view.
    pub pixels: [Vec<Pixel>; 2],
}

/// A cell with its images.
pub struct Cell {
    /// What it is.
    pub kind: Kind,
    /// What it was drawn from.
    pub seed: u64,
    /// Left and right image.
    pub images: [GreyImage; 2],
    /// The cameras as they are.
    pub true_rig: Rig,
    /// The gripper, its jaws wide enough for any wheel: what is judged is the rim.
    pub gripper: GripperFile,
    /// The painted circle or ellipse.
    pub paint: Option<TrueRim>,
    /// The bar.
    pub bar: Option<TrueRim>,
    clicks: [Option<[Pixel; 2]>; 3],
    options: Options,
}

impl Kind {
    fn options(self) -> Options {
        let alone = Options { with_arm: false, ..Options::default() };
        let paint = Options { core_radius_m: [0.0715, 0.0715], rim_occlusion: 0.3, tilt_deg: [5.0, 40.0], ..alone };
        match self {
            Self::Paint => paint,
            Self::Thin => Options { bar_radius_m: [0.008, 0.010], ..paint },
            Self::Torus => Options {
                core_radius_m: [0.050, 0.150],
                bar_radius_m: [0.006, 0.015],
                paint_width_m: 0.0,
                tilt_deg: [15.0, 60.0],
                ..alone
            },
            // Rig and place of a wheel as wide as the ellipse may be, which takes its place.
            Self::Ellipse => {
                Options { core_radius_m: [0.06, 0.09], paint_width_m: 0.0, tilt_deg: [6.0, 34.0], ..alone }
            }
        }
    }
}

impl Cell {
    /// Draws and renders a cell; the same kind, seed and noise give the same cell.
    pub fn new(kind: Kind, seed: u64, noise: Noise) -> Result<Self, String> {
        let mut options = kind.options();
        if matches!(noise, Noise::Gaussian | Noise::Poisson) {
            options.noise = 0.0;
        }
        let s = Scenario::from_seed(seed, &options).map_err(|e| e.to_string())?;
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x6a75_6467);
        let mut gripper = s.gripper.clone();
        gripper.opening[1] = 1.0;
        let pose = s.left_from_object();
        let normal = pose.rotation * Vec3::z();
        let (mut paint, mut bar, mut clicks) = (None, None, [None; 3]);
        let grey: [Vec<u8>; 2];
        if kind == Kind::Ellipse {
            let radius = s.stage.wheel.core_radius_m;
            let turn = rng.random_range(0.0..TAU);
            let mut shape = Shape::circle(pose.translation.vector, normal, radius, None);
            shape.axis_a = pose.rotation * Vec3::new(turn.cos(), turn.sin(), 0.0);
            shape.axes[1] = radius * rng.random_range(0.55..0.95);
            grey = View::BOTH.map(|v| ellipse_image(&s, v, &shape, noise, &mut rng));
            let rim = TrueRim { shape, pixels: seen_pixels(&s, &shape) };
            clicks[Click::Paint as usize] =
                Some(View::BOTH.map(|v| hand(*pick(&rim.pixels[v.index()], &mut rng), &mut rng)));
            paint = Some(rim);
        } else {
            let w = &s.stage.wheel;
            let at = |z: f64| (pose * Point3::new(0.0, 0.0, z)).coords;
            let rim = |shape: Shape| TrueRim { shape, pixels: seen_pixels(&s, &shape) };
            let core = Shape::circle(at(w.core_z()), normal, w.core_radius_m, Some(w.bar_radius_m));
            if let Some([_, outer]) = w.paint_radii() {
                paint = Some(rim(Shape::circle(at(0.0), normal, outer, None)));
                clicks[Click::Paint as usize] = Some(s.clicks);
            }
            for (click, side) in [(Click::Outer, 0), (Click::Inner, 1)] {
                let [l, r] = View::BOTH.map(|v| silhouette_click(&s, &core, v, side, &mut rng));
                clicks[click as usize] = l.zip(r).map(|(l, r)| [l, r]);
            }
            bar = Some(rim(core));
            let shot = Snapshot { object_from_gripper: [None; 2], opening: 0.1, frame: 0, hidden_marks: 0 };
            let mut renderer = s.renderer();
            grey = View::BOTH.map(|v| with_noise(renderer.image(v, &shot).into_raw(), noise, &mut rng));
        }
        let size = s.true_rig.left;
        let (w, h) = (size.width as usize, size.height as usize);
        let mut images = Vec::new();
        for g in grey {
            let g = if noise == Noise::Jpeg { through_jpeg(&g, w as u32, h as u32)? } else { g };
            images.push(GreyImage::new(w, h, g).ok_or("the image has not the camera's size")?);
        }
        let images: [GreyImage; 2] = images.try_into().map_err(|_| "two views, two images")?;
        Ok(Self { kind, seed, images, true_rig: s.true_rig, gripper, paint, bar, clicks, options })
    }

    /// The rig as given, wrong by an error: the scenario's own way of misleading.
    pub fn given(&self, error: &RigError) -> Result<Rig, String> {
        let s = Scenario::from_seed(self.seed, &error.applied(&self.options)).map_err(|e| e.to_string())?;
        if s.true_rig != self.true_rig {
            return Err("the rig's error changes the cell itself".into());
        }
        Ok(s.given_rig)
    }

    /// Where the operator clicks in both images; `None` where this cell has no such place.
    pub fn click(&self, click: Click) -> Option<[Pixel; 2]> {
        self.clicks[click as usize]
    }
}

fn pick<'a, T>(from: &'a [T], rng: &mut impl Rng) -> &'a T {
    &from[rng.random_range(0..from.len())]
}

/// A place as a hand hits it.
fn hand(at: Pixel, rng: &mut impl Rng) -> Pixel {
    at + Pixel::new(rng.random_range(-HAND_PX..HAND_PX), rng.random_range(-HAND_PX..HAND_PX))
}

/// An eye and a direction in the object's frame.
fn object_ray(s: &Scenario, view: View, pixel: Pixel) -> Option<(Vec3, Vec3)> {
    let to_object = s.left_from_object().inverse();
    let way = s.true_rig.view_from_left(view).inverse().rotation * s.true_rig.camera(view).ray(pixel)?;
    Some(((to_object * Point3::from(s.true_rig.centre(view))).coords, to_object.rotation * way))
}

/// Whether nothing of the wheel stands before a point of it.
fn is_seen(s: &Scenario, view: View, x: &Vec3) -> bool {
    let to_object = s.left_from_object().inverse();
    let eye = (to_object * Point3::from(s.true_rig.centre(view))).coords;
    let to = (to_object * Point3::from(*x)).coords - eye;
    s.stage.wheel.trace(&eye, &to.normalize()).is_none_or(|(t, _, _)| t > to.norm() - NEARER_M)
}

/// Exact raw pixels of what a view sees of a rim's edges.
fn seen_pixels(s: &Scenario, shape: &Shape) -> [Vec<Pixel>; 2] {
    let plain = s.stage.wheel.paint_width_m == 0.0 && shape.bar.is_none();
    View::BOTH.map(|view| {
        let eye = s.true_rig.centre(view);
        let points: Vec<Vec3> = match shape.bar {
            None => around(POINTS).map(|a| shape.point(a)).collect(),
            Some(_) => around(POINTS / 2).filter_map(|a| shape.outlines(&eye, a)).flatten().collect(),
        };
        // The board of an ellipse stands alone: the wheel whose place it took hides nothing.
        let seen = points.iter().filter(|x| plain || is_seen(s, view, x));
        seen.filter_map(|x| s.true_rig.project(view, x)).collect()
    })
}

/// A click on a visible piece of the bar's outer (0) or inner (1) outline, with bar on one side and none of the wheel on the other.
fn silhouette_click(s: &Scenario, core: &Shape, view: View, side: usize, rng: &mut impl Rng) -> Option<Pixel> {
    let eye = s.true_rig.centre(view);
    for _ in 0..400 {
        let angle = rng.random_range(0.0..TAU);
        let edge = core.outlines(&eye, angle)?[side];
        let Some(at) = s.true_rig.project(view, &edge) else { continue };
        let Some(middle) = s.true_rig.project(view, &core.point(angle)) else { continue };
        let Some(out) = (at - middle).try_normalize(1e-9) else { continue };
        let meets =
            |p: Pixel| object_ray(s, view, p).map(|(o, d)| s.stage.wheel.trace(&o, &d).map(|(_, part, _)| part));
        let (inside, outside) = (meets(at - out * CLEAR_PX), meets(at + out * CLEAR_PX));
        let in_image = s.true_rig.camera(view).contains(at, 10.0);
        if in_image && inside == Some(Some(Part::Rim)) && outside == Some(None) && is_seen(s, view, &edge) {
            return Some(hand(at, rng));
        }
    }
    None
}

/// Adds noise to a clean image where it is not the renderer's own.
fn with_noise(mut grey: Vec<u8>, noise: Noise, rng: &mut impl Rng) -> Vec<u8> {
    if matches!(noise, Noise::Gaussian | Noise::Poisson) {
        for g in &mut grey {
            *g = noisy(f64::from(*g), noise, rng);
        }
    }
    grey
}

fn noisy(grey: f64, noise: Noise, rng: &mut impl Rng) -> u8 {
    let sigma = match noise {
        Noise::Scene | Noise::Jpeg => 2.0,
        Noise::Gaussian => 2.5,
        Noise::Poisson => (1.0 + 0.05 * grey.max(0.0)).sqrt(),
    };
    let n: f64 = rng.sample(StandardNormal);
    (grey + sigma * n).round().clamp(0.0, 255.0) as u8
}

fn through_jpeg(grey: &[u8], w: u32, h: u32) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY)
        .encode(grey, w, h, ExtendedColorType::L8)
        .map_err(|e| e.to_string())?;
    let decoder = JpegDecoder::new(std::io::Cursor::new(bytes)).map_err(|e| e.to_string())?;
    Ok(DynamicImage::from_decoder(decoder).map_err(|e| e.to_string())?.into_luma8().into_raw())
}

/// A painted ellipse on a darker board that fills the view: area coverage on 4 x 4 places a pixel, then the lens's blur.
fn ellipse_image(s: &Scenario, view: View, shape: &Shape, noise: Noise, rng: &mut ChaCha8Rng) -> Vec<u8> {
    const FINE: usize = 4;
    let camera = s.true_rig.camera(view);
    let (w, h) = (camera.width as usize, camera.height as usize);
    let left_from_view: Pose = s.true_rig.view_from_left(view).inverse();
    let eye = s.true_rig.centre(view);
    let axis_b = shape.normal.cross(&shape.axis_a);
    let inside = |p: Pixel| {
        let Some(way) = camera.ray(p).map(|d| left_from_view.rotation * d) else { return false };
        let x = eye + way * ((shape.centre - eye).dot(&shape.normal) / way.dot(&shape.normal)) - shape.centre;
        (x.dot(&shape.axis_a) / shape.axes[0]).hypot(x.dot(&axis_b) / shape.axes[1]) < 1.0
    };
    let outline: Vec<Pixel> = around(720).filter_map(|a| s.true_rig.project(view, &shape.point(a))).collect();
    let near = |f: fn(f64, f64) -> f64, of: fn(&Pixel) -> f64| outline.iter().map(of).reduce(f).unwrap_or(0.0);
    let (u0, u1) = (near(f64::min, |p| p.x) as usize - 2, near(f64::max, |p| p.x) as usize + 3);
    let (v0, v1) = (near(f64::min, |p| p.y) as usize - 2, near(f64::max, |p| p.y) as usize + 3);
    let mut covered = vec![0.0f64; w * h];
    for v in v0..v1 {
        for u in u0..u1 {
            let sub = |i: usize| (i as f64 + 0.5) / FINE as f64 - 0.5;
            let hits = (0..FINE * FINE)
                .filter(|k| inside(Pixel::new(u as f64 + sub(k % FINE), v as f64 + sub(k / FINE))))
                .count();
            covered[v * w + u] = hits as f64 / (FINE * FINE) as f64;
        }
    }
    let sigma = s.sensor.blur_px;
    let kernel: Vec<f64> = (-3..=3).map(|k: i32| (-0.5 * (f64::from(k) / sigma).powi(2)).exp()).collect();
    let total: f64 = kernel.iter().sum();
    let blur = |from: &[f64], step: usize| -> Vec<f64> {
        let mut to = vec![0.0; from.len()];
        for i in 3 * step..from.len() - 3 * step {
            to[i] = kernel.iter().enumerate().map(|(k, g)| g * from[i + k * step - 3 * step]).sum::<f64>() / total;
        }
        to
    };
    let soft = blur(&blur(&covered, 1), w);
    let (dark, light) = (s.stage.white * s.stage.albedo[1], s.stage.white * s.stage.albedo[0]);
    soft.iter().map(|c| noisy(dark + (light - dark) * c, noise, rng)).collect()
}
