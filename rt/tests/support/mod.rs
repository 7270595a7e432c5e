//! A small exact renderer for tests: discs and quadrilaterals integrated over each pixel, with blur, noise and
//! lighting.
//!
//! Outlines are projected point by point through the lens model and filled with exact area coverage (signed areas, as
//! font rasterizers do), so that the images have no sampling error that a tracker could be tuned to.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used)]

use graspd_rt::geom::{Camera, Distortion, Pose, Rig, Vec3, View, exp_twist};
use graspd_rt::gripper::{Gripper, Mark};
use graspd_rt::image::ImageView;
use graspd_rt::online::StereoFrame;
use nalgebra::{Point3, Vector6};

/// A random generator with the same stream on every platform (splitmix64).
#[derive(Clone)]
pub struct Random(pub u64);

impl Random {
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }
    pub fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1_u64 << 53) as f64
    }
    pub fn range(&mut self, lo: f64, hi: f64) -> f64 {
        lo + (hi - lo) * self.unit()
    }
    pub fn normal(&mut self) -> f64 {
        (-2.0 * self.unit().max(1e-300).ln()).sqrt() * (std::f64::consts::TAU * self.unit()).cos()
    }
    pub fn direction(&mut self) -> Vec3 {
        Vec3::new(self.normal(), self.normal(), self.normal()).normalize()
    }
}

pub struct Canvas {
    pub width: usize,
    pub height: usize,
    pub light: Vec<f32>,
}

impl Canvas {
    pub fn new(width: usize, height: usize, level: f64) -> Self {
        Self { width, height, light: vec![level as f32; width * height] }
    }

    /// Fills a polygon (pixels) with a level, by exact area coverage, blurred by a Gaussian of `blur` pixels.
    pub fn fill(&mut self, polygon: &[(f64, f64)], level: f64, blur: f64) {
        let pad = (3.5 * blur).ceil() + 2.0;
        let (mut x0, mut y0, mut x1, mut y1) = (f64::MAX, f64::MAX, f64::MIN, f64::MIN);
        for p in polygon {
            (x0, y0, x1, y1) = (x0.min(p.0), y0.min(p.1), x1.max(p.0), y1.max(p.1));
        }
        let (x0, y0) = ((x0 - pad).floor(), (y0 - pad).floor());
        let (w, h) = ((x1 + pad - x0).ceil() as usize + 2, (y1 + pad - y0).ceil() as usize + 2);
        if w > 4000 || h > 4000 {
            return;
        }
        // Pixel (0, 0) covers [-0.5, 0.5]; the accumulator has its corners at integers.
        let mut acc = vec![0.0_f64; w * h + 2];
        for i in 0..polygon.len() {
            let (a, b) = (polygon[i], polygon[(i + 1) % polygon.len()]);
            line(&mut acc, w, (a.0 - x0 + 0.5, a.1 - y0 + 0.5), (b.0 - x0 + 0.5, b.1 - y0 + 0.5));
        }
        let mut cover = vec![0.0_f64; w * h];
        for y in 0..h {
            let mut sum = 0.0;
            for x in 0..w {
                sum += acc[y * w + x];
                cover[y * w + x] = sum.abs().min(1.0);
            }
        }
        if blur > 0.0 {
            cover = smooth(&cover, w, h, blur);
        }
        for y in 0..h {
            let v = y as i64 + y0 as i64;
            for x in 0..w {
                let u = x as i64 + x0 as i64;
                if u >= 0 && v >= 0 && (u as usize) < self.width && (v as usize) < self.height {
                    let p = &mut self.light[v as usize * self.width + u as usize];
                    *p += (cover[y * w + x] * (level - f64::from(*p))) as f32;
                }
            }
        }
    }

    /// Applies gain, offset and a ramp over the image, then noise and rounding to bytes.
    pub fn expose(&self, camera: &Exposure, random: &mut Random) -> Vec<u8> {
        let table: Vec<f32> = (0..4096).map(|_| (random.normal() * camera.noise) as f32).collect();
        let across: Vec<f32> = (0..self.width)
            .map(|x| (camera.gain * camera.ramp.0 * (x as f64 / self.width as f64 - 0.5)) as f32)
            .collect();
        let mut out = vec![0; self.light.len()];
        let rows = self.light.chunks_exact(self.width).zip(out.chunks_exact_mut(self.width));
        for (y, (light, out)) in rows.enumerate() {
            let mut k = random.bits();
            let gain = (camera.gain * (1.0 + camera.ramp.1 * (y as f64 / self.height as f64 - 0.5))) as f32;
            let offset = camera.offset as f32 + 0.5;
            for ((o, l), a) in out.iter_mut().zip(light).zip(&across) {
                k = k.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                // The cast saturates.
                *o = (l * (gain + a) + offset + table[(k >> 52) as usize]) as u8;
            }
        }
        out
    }
}

#[derive(Clone, Copy)]
pub struct Exposure {
    pub gain: f64,
    pub offset: f64,
    pub ramp: (f64, f64),
    pub noise: f64,
}

impl Default for Exposure {
    fn default() -> Self {
        Self { gain: 1.0, offset: 0.0, ramp: (0.0, 0.0), noise: 2.0 }
    }
}

/// Adds the signed areas of one edge to the accumulator (the running sum of a row is the coverage).
fn line(acc: &mut [f64], w: usize, a: (f64, f64), b: (f64, f64)) {
    if a.1 == b.1 {
        return;
    }
    let (dir, p, q) = if a.1 < b.1 { (1.0, a, b) } else { (-1.0, b, a) };
    let dxdy = (q.0 - p.0) / (q.1 - p.1);
    let mut x = p.0;
    let mut y = p.1;
    for row in p.1.floor() as usize..q.1.ceil() as usize {
        let bottom = (row as f64 + 1.0).min(q.1);
        let dy = bottom - y;
        if dy <= 0.0 {
            continue;
        }
        let xn = x + dxdy * dy;
        let d = dy * dir;
        let (l, r) = if x < xn { (x, xn) } else { (xn, x) };
        let (lf, rc) = (l.floor(), r.ceil());
        let i = row * w + lf as usize;
        if rc <= lf + 1.0 {
            let m = 0.5 * (x + xn) - lf;
            acc[i] += d * (1.0 - m);
            acc[i + 1] += d * m;
        } else {
            let s = 1.0 / (r - l);
            let f = l - lf;
            let a0 = 0.5 * s * (1.0 - f) * (1.0 - f);
            let f1 = r - rc + 1.0;
            let am = 0.5 * s * f1 * f1;
            let n = (rc - lf) as usize;
            acc[i] += d * a0;
            if n == 2 {
                acc[i + 1] += d * (1.0 - a0 - am);
            } else {
                let a1 = s * (1.5 - f);
                acc[i + 1] += d * (a1 - a0);
                for k in 2..n - 1 {
                    acc[i + k] += d * s;
                }
                let a2 = a1 + (n as f64 - 3.0) * s;
                acc[i + n - 1] += d * (1.0 - a2 - am);
            }
            acc[i + n] += d * am;
        }
        (x, y) = (xn, bottom);
    }
}

fn smooth(src: &[f64], w: usize, h: usize, sigma: f64) -> Vec<f64> {
    let n = (3.5 * sigma).ceil() as i64;
    let kernel: Vec<f64> = (-n..=n).map(|i| (-0.5 * (i as f64 / sigma).powi(2)).exp()).collect();
    let sum: f64 = kernel.iter().sum();
    let pass = |src: &[f64], dx: i64, dy: i64| {
        let mut out = vec![0.0; w * h];
        for y in 0..h as i64 {
            for x in 0..w as i64 {
                let mut s = 0.0;
                for (k, g) in kernel.iter().enumerate() {
                    let (u, v) = (x + dx * (k as i64 - n), y + dy * (k as i64 - n));
                    if u >= 0 && v >= 0 && u < w as i64 && v < h as i64 {
                        s += g * src[v as usize * w + u as usize];
                    }
                }
                out[y as usize * w + x as usize] = s / sum;
            }
        }
        out
    };
    pass(&pass(src, 1, 0), 0, 1)
}

/// Outline of a disc, pixels; `None` if it faces away or is behind the camera.
pub fn rim(camera: &Camera, camera_from_gripper: &Pose, mark: &Mark) -> Option<Vec<(f64, f64)>> {
    let c = (camera_from_gripper * Point3::from(mark.position)).coords;
    let n = camera_from_gripper.rotation * mark.normal;
    if n.dot(&c) >= 0.0 {
        return None;
    }
    let a = n.cross(&if n.x.abs() < 0.7 { Vec3::x() } else { Vec3::y() }).normalize();
    let b = n.cross(&a);
    (0..192)
        .map(|k| {
            let t = std::f64::consts::TAU * f64::from(k) / 192.0;
            // The polygon has the area of the disc.
            let r = mark.radius * (1.0 + (std::f64::consts::PI / 192.0).powi(2) / 3.0);
            camera.project(&(c + (a * t.cos() + b * t.sin()) * r)).map(|p| (p.x, p.y))
        })
        .collect()
}

pub struct Scene {
    pub background: f64,
    pub dark: f64,
    pub light: f64,
    pub plate: f64,
    pub blur: f64,
}

impl Default for Scene {
    fn default() -> Self {
        Self { background: 120.0, dark: 35.0, light: 215.0, plate: 190.0, blur: 0.7 }
    }
}

impl Scene {
    /// Draws the gripper's marks, each on a square plate 1.6 times its size (light round dark marks, dark round light
    /// ones).
    pub fn draw(&self, canvas: &mut Canvas, rig: &Rig, view: View, gripper: &Gripper, pose: &Pose, hidden: &[usize]) {
        let camera = rig.camera(view);
        let camera_from_gripper = rig.view_from_left(view) * pose;
        for (i, mark) in gripper.marks.iter().enumerate() {
            if hidden.contains(&i) {
                continue;
            }
            let plate = Mark { radius: mark.radius * 1.6, ..*mark };
            let (disc, ground) = if mark.dark { (self.dark, self.plate) } else { (self.light, 60.0) };
            if let (Some(p), Some(r)) =
                (rim(camera, &camera_from_gripper, &plate), rim(camera, &camera_from_gripper, mark))
            {
                canvas.fill(&p, ground, self.blur);
                canvas.fill(&r, disc, self.blur);
            }
        }
    }
}

pub fn camera(distorted: bool) -> Camera {
    let distortion = if distorted {
        Distortion { k1: -0.18, k2: 0.07, p1: 4e-4, p2: -3e-4, ..Default::default() }
    } else {
        Distortion::default()
    };
    Camera { width: 1280, height: 1024, fx: 1200.0, fy: 1198.0, cx: 642.0, cy: 509.0, distortion }.validated().unwrap()
}

/// Two cameras 0.5 m apart, both looking at a point 1.5 m ahead.
pub fn rig(distorted: bool) -> Rig {
    let left = camera(distorted);
    let toe = 2.0 * (0.25_f64 / 1.5).atan();
    let left_from_right = Pose::from_parts(
        nalgebra::Translation3::new(0.5 * (toe / 2.0).cos(), 0.01, 0.5 * (toe / 2.0).sin()),
        exp_twist(&Vector6::new(0.0, 0.0, 0.0, 0.004, -toe, 0.003)).rotation,
    );
    Rig { left, right: Camera { fx: 1207.0, cx: 633.0, ..left }, right_from_left: left_from_right.inverse() }
}

/// Sixteen marks of 11 mm radius (about 9 px at 1.5 m) without symmetry, on a curved front, with normals spread by up
/// to 25 degrees.
pub fn gripper() -> Gripper {
    let mut marks = heapless::Vec::new();
    let spots = [
        (-72.0, -58.0),
        (-31.0, -66.0),
        (8.0, -60.0),
        (44.0, -69.0),
        (79.0, -51.0),
        (-80.0, -19.0),
        (-38.0, -24.0),
        (3.0, -15.0),
        (49.0, -28.0),
        (84.0, -9.0),
        (-68.0, 22.0),
        (-24.0, 29.0),
        (22.0, 24.0),
        (66.0, 33.0),
        (-44.0, 63.0),
        (31.0, 61.0),
    ];
    for (k, (x, y)) in spots.iter().enumerate() {
        let (x, y) = (x * 1e-3, y * 1e-3);
        let z = -0.06 + 1.2 * (x * x + y * y) + if k % 3 == 0 { 0.012 } else { 0.0 };
        let normal = Vec3::new(3.5 * x, 3.5 * y, -1.0).normalize();
        marks.push(Mark { position: Vec3::new(x, y, z), normal, radius: 0.011, dark: k % 5 != 4 }).unwrap();
    }
    Gripper { marks, flange_from_gripper: Pose::identity() }
}

/// A pose about 1.5 m in front of the left camera, the marks facing the cameras, tilted by up to `tilt` radians.
pub fn pose(random: &mut Random, tilt: f64) -> Pose {
    let t = Vec3::new(0.25 + random.range(-0.15, 0.15), random.range(-0.18, 0.18), 1.5 + random.range(-0.15, 0.15));
    let spin = exp_twist(&Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, random.range(-3.1, 3.1)));
    let axis = random.direction() * random.range(0.0, tilt);
    let tip = exp_twist(&Vector6::new(0.0, 0.0, 0.0, axis.x, axis.y, axis.z * 0.3));
    Pose::from_parts(t.into(), tip.rotation * spin.rotation)
}

/// A pose as of [`pose`], moved along the line of sight to the distance `z`.
pub fn pose_at(random: &mut Random, tilt: f64, z: f64) -> Pose {
    let mut p = pose(random, tilt);
    let t = &mut p.translation.vector;
    *t = Vec3::new(0.25 + (t.x - 0.25) * z / 1.5, t.y * z / 1.5, z);
    p
}

pub struct Pair {
    pub left: Vec<u8>,
    pub right: Vec<u8>,
    pub width: usize,
    pub height: usize,
}

impl Pair {
    pub fn frame(&self, sequence: u64) -> StereoFrame<'_> {
        let t = sequence * 16_000_000;
        StereoFrame {
            left: ImageView::new(&self.left, self.width, self.height, self.width).unwrap(),
            right: ImageView::new(&self.right, self.width, self.height, self.width).unwrap(),
            sequence,
            capture_ns: [t, t + 200_000],
            now_ns: t + 9_000_000,
        }
    }
}

pub fn render(
    rig: &Rig,
    gripper: &Gripper,
    pose: &Pose,
    scene: &Scene,
    exposure: &Exposure,
    random: &mut Random,
    extra: &mut dyn FnMut(View, &mut Canvas),
) -> Pair {
    let mut out = View::BOTH.map(|view| {
        let c = rig.camera(view);
        let mut canvas = Canvas::new(c.width as usize, c.height as usize, scene.background);
        scene.draw(&mut canvas, rig, view, gripper, pose, &[]);
        extra(view, &mut canvas);
        canvas.expose(exposure, random)
    });
    Pair {
        left: std::mem::take(&mut out[0]),
        right: std::mem::take(&mut out[1]),
        width: rig.left.width as usize,
        height: rig.left.height as usize,
    }
}

pub fn circle(u: f64, v: f64, r: f64) -> Vec<(f64, f64)> {
    (0..96).map(|k| f64::from(k) * std::f64::consts::TAU / 96.0).map(|t| (u + r * t.cos(), v + r * t.sin())).collect()
}

pub fn rectangle(u: f64, v: f64, w: f64, h: f64) -> Vec<(f64, f64)> {
    vec![(u, v), (u + w, v), (u + w, v + h), (u, v + h)]
}

/// A small random screw, `mm` millimetres and `deg` degrees long.
pub fn nudge(random: &mut Random, mm: f64, deg: f64) -> Pose {
    let (t, w) = (random.direction() * mm * 1e-3, random.direction() * deg.to_radians());
    exp_twist(&Vector6::new(t.x, t.y, t.z, w.x, w.y, w.z))
}
