//! A cell for judging: two images, the true rims in them, clicks of an operator, and the rig with any error.

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

/// Largest error of a click along each axis, pixels; that of the scenario's own clicks.
const MAX_CLICK_ERROR_PX: f64 = 1.2;
/// Distance to either side of an outline at which a click needs the bar and its background, pixels; above the click
/// error.
const CLEARANCE_PX: f64 = 2.0;
/// A surface occludes a point if it is nearer to the camera by this much, metres; above the distance at which a grazing
/// ray first hits the bar.
const MIN_OCCLUSION_M: f64 = 1e-3;
/// JPEG quality of the round trip.
const JPEG_QUALITY: u8 = 85;

/// A kind of cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// A painted circle of 75 mm on a bar, 30 % occluded.
    Paint,
    /// The same on a thinner bar, whose silhouette is close to the paint.
    Thin,
    /// A bare wheel of any size.
    Torus,
    /// A painted ellipse on a board, from a separate renderer.
    Ellipse,
}

/// Place of the operator's click.
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

/// Image noise.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Noise {
    /// That of the renderers: read and photon noise of the scene, 2 grey values for ellipses.
    Scene,
    /// 2.5 grey values everywhere.
    Gaussian,
    /// Variance of 1 plus a twentieth of the grey value.
    Poisson,
    /// That of the renderers, then a JPEG round trip at quality 85.
    Jpeg,
}

/// Error of the given rig: both focal lengths, percent, and the relative rotation, degrees; the seed determines sign
/// and axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RigError {
    /// Of the focal lengths, percent.
    pub focal_percent: f64,
    /// Of the relative rotation, degrees.
    pub rotation_deg: f64,
}

impl RigError {
    /// Parses `0`, `0.5:0.1` or `0.5,0.1`.
    pub fn parse(text: &str) -> Result<Self, String> {
        let bad = || {
            format!("rig error {text:?}: expected percent of focal length and degrees of rotation, for example 0.5:0.1")
        };
        let (f, r) = text.split_once([':', ',']).unwrap_or((text, "0"));
        let number = |s: &str| s.trim().parse::<f64>().ok().filter(|v| v.is_finite()).ok_or_else(bad);
        let e = Self { focal_percent: number(f)?, rotation_deg: number(r)? };
        if text.contains([':', ',']) || e.focal_percent == 0.0 { Ok(e) } else { Err(bad()) }
    }

    /// Scenario options with this error.
    pub fn applied(&self, o: &Options) -> Options {
        Options { focal_error: self.focal_percent / 100.0, rotation_error_deg: self.rotation_deg, ..*o }
    }
}

impl std::fmt::Display for RigError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} %, {} deg", self.focal_percent, self.rotation_deg)
    }
}

/// A rim of the cell, and the exact raw pixels of its visible edges.
#[derive(Clone, Debug)]
pub struct TrueRim {
    /// The rim.
    pub shape: Shape,
    /// Edge pixels in each view.
    pub pixels: [Vec<Pixel>; 2],
}

/// A cell with its images.
pub struct Cell {
    /// Kind of cell.
    pub kind: Kind,
    /// Its seed.
    pub seed: u64,
    /// Left and right image.
    pub images: [GreyImage; 2],
    /// True cameras.
    pub true_rig: Rig,
    /// The gripper, its jaws wide enough for any wheel, because only the rim is judged.
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
            // Rig and pose of a wheel of the ellipse's size, which the ellipse replaces.
            Self::Ellipse => {
                Options { core_radius_m: [0.06, 0.09], paint_width_m: 0.0, tilt_deg: [6.0, 34.0], ..alone }
            }
        }
    }
}

impl Cell {
    /// Draws and renders a cell; equal kind, seed and noise give equal cells.
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
                Some(View::BOTH.map(|v| click_near(*pick(&rim.pixels[v.index()], &mut rng), &mut rng)));
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
            images.push(GreyImage::new(w, h, g).ok_or("image size mismatch with the camera")?);
        }
        let images: [GreyImage; 2] = images.try_into().map_err(|_| "two views, two images")?;
        Ok(Self { kind, seed, images, true_rig: s.true_rig, gripper, paint, bar, clicks, options })
    }

    /// The given rig with an error, as the scenario applies it.
    pub fn given(&self, error: &RigError) -> Result<Rig, String> {
        let s = Scenario::from_seed(self.seed, &error.applied(&self.options)).map_err(|e| e.to_string())?;
        if s.true_rig != self.true_rig {
            return Err("the rig's error changes the cell itself".into());
        }
        Ok(s.given_rig)
    }

    /// The operator's click in both images; `None` if this cell has no such place.
    pub fn click(&self, click: Click) -> Option<[Pixel; 2]> {
        self.clicks[click as usize]
    }
}

fn pick<'a, T>(from: &'a [T], rng: &mut impl Rng) -> &'a T {
    &from[rng.random_range(0..from.len())]
}

/// A click with the operator's error.
fn click_near(at: Pixel, rng: &mut impl Rng) -> Pixel {
    at + Pixel::new(
        rng.random_range(-MAX_CLICK_ERROR_PX..MAX_CLICK_ERROR_PX),
        rng.random_range(-MAX_CLICK_ERROR_PX..MAX_CLICK_ERROR_PX),
    )
}

/// Camera centre and viewing direction of a pixel in the object frame.
fn object_ray(s: &Scenario, view: View, pixel: Pixel) -> Option<(Vec3, Vec3)> {
    let to_object = s.left_from_object().inverse();
    let way = s.true_rig.view_from_left(view).inverse().rotation * s.true_rig.camera(view).ray(pixel)?;
    Some(((to_object * Point3::from(s.true_rig.centre(view))).coords, to_object.rotation * way))
}

/// Whether the wheel does not occlude a point of its own.
fn is_seen(s: &Scenario, view: View, x: &Vec3) -> bool {
    let to_object = s.left_from_object().inverse();
    let camera_centre = (to_object * Point3::from(s.true_rig.centre(view))).coords;
    let to = (to_object * Point3::from(*x)).coords - camera_centre;
    s.stage.wheel.trace(&camera_centre, &to.normalize()).is_none_or(|(t, _, _)| t > to.norm() - MIN_OCCLUSION_M)
}

/// Exact raw pixels of the visible edges of a rim in both images.
fn seen_pixels(s: &Scenario, shape: &Shape) -> [Vec<Pixel>; 2] {
    let plain = s.stage.wheel.paint_width_m == 0.0 && shape.bar.is_none();
    View::BOTH.map(|view| {
        let camera_centre = s.true_rig.centre(view);
        let points: Vec<Vec3> = match shape.bar {
            None => around(POINTS).map(|a| shape.point(a)).collect(),
            Some(_) => around(POINTS / 2).filter_map(|a| shape.outlines(&camera_centre, a)).flatten().collect(),
        };
        // The board of an ellipse has no wheel that could occlude it.
        let seen = points.iter().filter(|x| plain || is_seen(s, view, x));
        seen.filter_map(|x| s.true_rig.project(view, x)).collect()
    })
}

/// A click on a visible part of the bar's outer (0) or inner (1) outline, with the bar on one side and background on
/// the other.
fn silhouette_click(s: &Scenario, core: &Shape, view: View, side: usize, rng: &mut impl Rng) -> Option<Pixel> {
    let camera_centre = s.true_rig.centre(view);
    for _ in 0..400 {
        let angle = rng.random_range(0.0..TAU);
        let edge = core.outlines(&camera_centre, angle)?[side];
        let Some(at) = s.true_rig.project(view, &edge) else { continue };
        let Some(middle) = s.true_rig.project(view, &core.point(angle)) else { continue };
        let Some(out) = (at - middle).try_normalize(1e-9) else { continue };
        let meets =
            |p: Pixel| object_ray(s, view, p).map(|(o, d)| s.stage.wheel.trace(&o, &d).map(|(_, part, _)| part));
        let (inside, outside) = (meets(at - out * CLEARANCE_PX), meets(at + out * CLEARANCE_PX));
        let in_image = s.true_rig.camera(view).contains(at, 10.0);
        if in_image && inside == Some(Some(Part::Rim)) && outside == Some(None) && is_seen(s, view, &edge) {
            return Some(click_near(at, rng));
        }
    }
    None
}

/// Adds noise to an image that was rendered without noise.
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

/// A painted ellipse on a darker board that fills the view: area coverage from 4 x 4 samples per pixel, then the lens's
/// blur.
fn ellipse_image(s: &Scenario, view: View, shape: &Shape, noise: Noise, rng: &mut ChaCha8Rng) -> Vec<u8> {
    const FINE: usize = 4;
    let camera = s.true_rig.camera(view);
    let (w, h) = (camera.width as usize, camera.height as usize);
    let left_from_view: Pose = s.true_rig.view_from_left(view).inverse();
    let camera_centre = s.true_rig.centre(view);
    let axis_b = shape.normal.cross(&shape.axis_a);
    let inside = |p: Pixel| {
        let Some(way) = camera.ray(p).map(|d| left_from_view.rotation * d) else { return false };
        let x = camera_centre + way * ((shape.centre - camera_centre).dot(&shape.normal) / way.dot(&shape.normal))
            - shape.centre;
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
