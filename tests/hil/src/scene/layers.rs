//! The fixed layers of one view, rendered once: the backdrop, and the valve with its coverage and depth.

use super::raster::Rect;
use super::sensor::{SCALE, Sensor};
use super::stage::{Stage, Thing};
use graspd_rt::geom::{Camera, Pixel, Pose, Vec3};

/// Samples along each side of a pixel in which the valve changes, and in which only the backdrop changes.
const FINE: [usize; 2] = [10, 4];
/// Pixels between exactly undistorted rays of a row; the rays between are interpolated, with an error below 0.001 px
/// for any lens.
const STEP: usize = 4;
/// Difference of grey between neighbouring pixels above which both are supersampled, grey values.
const MAX_GREY_STEP: f64 = 5.0;
/// Difference of distance between neighbouring pixels of the valve above which both are supersampled, m.
const MAX_DEPTH_STEP_M: f64 = 4e-3;

/// The fixed layers of one view. Grey values are linear and not blurred, except in `exposed`.
#[derive(Debug)]
pub(super) struct Layers {
    /// Width in pixels.
    pub(super) width: usize,
    /// Height in pixels.
    pub(super) height: usize,
    /// Grey values behind the valve.
    pub(super) backdrop: Vec<f32>,
    /// Bounding rectangle of the valve.
    pub(super) valve_rect: Rect,
    /// Per pixel of `valve_rect`: grey value times coverage, coverage, and distance along the ray, m.
    pub(super) valve: Vec<[f32; 3]>,
    /// Viewing rays of the pixel centres of `valve_rect` in the camera frame.
    pub(super) rays: Vec<Vec3>,
    /// Relative illumination by the lens.
    pub(super) falloff: Vec<f32>,
    /// Blurred image without gripper in 64ths of a grey value, and the noise amplitude of each pixel.
    pub(super) exposed: (Vec<i16>, Vec<i16>),
}

impl Layers {
    /// Renders the layers of one view. Takes some tenths of a second.
    pub(super) fn render(stage: &Stage, camera: &Camera, camera_from_object: &Pose, sensor: &Sensor) -> Self {
        let tracer = Tracer::new(stage, camera, camera_from_object);
        let (w, h) = (tracer.width, tracer.height);
        let first = tracer.centres();
        let mut backdrop: Vec<f32> = first.iter().map(|((g, _), _)| *g as f32).collect();
        let mut valve: Vec<[f32; 3]> = first
            .iter()
            .map(|(_, v)| v.map_or([0.0, 0.0, f32::INFINITY], |(t, g, _)| [g as f32, 1.0, t as f32]))
            .collect();
        let fine = samples_per_side(&first, w, h);
        drop(first);
        for (i, side) in fine.iter().copied().enumerate().filter(|(_, n)| *n > 0) {
            (backdrop[i], valve[i]) = tracer.supersample((i % w) as f64, (i / w) as f64, side);
        }
        let falloff = falloff(sensor, w, h);
        for (i, f) in falloff.iter().enumerate() {
            backdrop[i] *= f;
            valve[i][0] *= f;
        }
        let touched = (0..w * h).filter(|i| valve[*i][1] > 0.0).map(|i| Pixel::new((i % w) as f64, (i / w) as f64));
        let valve_rect = Rect::around(touched, 0.0, w, h).unwrap_or(Rect { x0: 0, y0: 0, x1: 1, y1: 1 });
        let mut inside = Vec::with_capacity(valve_rect.width() * valve_rect.height());
        let mut rays = Vec::with_capacity(inside.capacity());
        for y in valve_rect.y0..valve_rect.y1 {
            for x in valve_rect.x0..valve_rect.x1 {
                inside.push(valve[y * w + x]);
                rays.push(tracer.ray(x as f64, y as f64));
            }
        }
        let mut layers = Self {
            width: w,
            height: h,
            backdrop,
            valve_rect,
            valve: inside,
            rays,
            falloff,
            exposed: (Vec::new(), Vec::new()),
        };
        layers.expose(sensor);
        layers
    }

    /// Unblurred grey value of the fixed scene at a pixel.
    pub(super) fn still(&self, x: usize, y: usize) -> f32 {
        let b = self.backdrop[y * self.width + x];
        match self.valve_at(x, y) {
            Some((v, _)) => v[0] + (1.0 - v[1]) * b,
            None => b,
        }
    }

    /// Valve layer and viewing ray at a pixel inside `valve_rect`.
    #[inline]
    pub(super) fn valve_at(&self, x: usize, y: usize) -> Option<(&[f32; 3], &Vec3)> {
        let r = &self.valve_rect;
        if x < r.x0 || x >= r.x1 || y < r.y0 || y >= r.y1 {
            return None;
        }
        let i = (y - r.y0) * r.width() + (x - r.x0);
        Some((self.valve.get(i)?, self.rays.get(i)?))
    }

    fn expose(&mut self, sensor: &Sensor) {
        let (w, h) = (self.width, self.height);
        let all = Rect { x0: 0, y0: 0, x1: w, y1: h };
        let mut image: Vec<f32> = (0..w * h).map(|i| self.still(i % w, i / w)).collect();
        let mut scratch = Vec::new();
        blur(&mut image, all.width(), &sensor.kernel(), &mut scratch);
        self.exposed.0 = image.iter().map(|g| (g * SCALE).clamp(0.0, 20_000.0) as i16).collect();
        self.exposed.1 = image.iter().map(|g| sensor.amplitude(*g)).collect();
    }
}

/// Relative illumination of each pixel, row by row.
fn falloff(sensor: &Sensor, w: usize, h: usize) -> Vec<f32> {
    let corner2 = (0.25 * ((w * w + h * h) as f64)).max(1.0);
    (0..w * h)
        .map(|i| {
            let (dx, dy) = ((i % w) as f64 - 0.5 * w as f64, (i / w) as f64 - 0.5 * h as f64);
            sensor.falloff((dx * dx + dy * dy) / corner2)
        })
        .collect()
}

/// The first hits of one ray: grey and object behind the valve; distance, grey and part of the valve.
type Hit = ((f64, Thing), Option<(f64, f64, Thing)>);

/// Whether two neighbouring rays met different objects or greys, so that the pixels need more samples.
fn differ((back_a, valve_a): &Hit, (back_b, valve_b): &Hit) -> bool {
    let step = |x: f64, y: f64| (x - y).abs() > MAX_GREY_STEP;
    back_a.1 != back_b.1
        || step(back_a.0, back_b.0)
        || match (valve_a, valve_b) {
            (None, None) => false,
            (Some(x), Some(y)) => x.2 != y.2 || step(x.1, y.1) || (x.0 - y.0).abs() > MAX_DEPTH_STEP_M,
            _ => true,
        }
}

/// Samples along each side of every pixel; 0 where the sample at its centre is enough.
fn samples_per_side(first: &[Hit], w: usize, h: usize) -> Vec<usize> {
    let mut fine = vec![0usize; w * h];
    for y in 0..h {
        for x in 0..w {
            let i = y * w + x;
            let mut mark = |j: usize| {
                if differ(&first[i], &first[j]) {
                    let n = FINE[usize::from(first[i].1.is_none() && first[j].1.is_none())];
                    fine[i] = fine[i].max(n);
                    fine[j] = fine[j].max(n);
                }
            };
            if x + 1 < w {
                mark(i + 1);
            }
            if y + 1 < h {
                mark(i + w);
                if x + 1 < w {
                    mark(i + w + 1);
                }
                if x > 0 {
                    mark(i + w - 1);
                }
            }
        }
    }
    fine
}

/// Traces rays of one camera through the fixed scene.
struct Tracer<'a> {
    stage: &'a Stage,
    camera: &'a Camera,
    object_from_camera: Pose,
    width: usize,
    height: usize,
}

impl<'a> Tracer<'a> {
    fn new(stage: &'a Stage, camera: &'a Camera, camera_from_object: &Pose) -> Self {
        let (width, height) = (camera.width as usize, camera.height as usize);
        Self { stage, camera, object_from_camera: camera_from_object.inverse(), width, height }
    }

    /// Viewing ray of a pixel in the camera frame.
    fn ray(&self, u: f64, v: f64) -> Vec3 {
        self.camera.ray(Pixel::new(u, v)).unwrap_or_else(Vec3::z)
    }

    /// The hits of the rays through all pixel centres, row by row.
    fn centres(&self) -> Vec<Hit> {
        let o = self.object_from_camera.translation.vector;
        let mut hits = Vec::with_capacity(self.width * self.height);
        for y in 0..self.height {
            let mut ends = [Vec3::z(); 2];
            for x in 0..self.width {
                if x % STEP == 0 {
                    ends = [self.ray(x as f64, y as f64), self.ray((x + STEP) as f64, y as f64)];
                }
                let c = ends[0].lerp(&ends[1], (x % STEP) as f64 / STEP as f64);
                let d = self.object_from_camera.rotation * c.normalize();
                hits.push((self.stage.backdrop(&o, &d), self.stage.valve(&o, &d)));
            }
        }
        hits
    }

    /// Averages `side` x `side` samples over the pixel at (`u`, `v`): grey of the backdrop, and of the valve its grey
    /// times coverage, coverage and smallest distance.
    fn supersample(&self, u: f64, v: f64, side: usize) -> (f32, [f32; 3]) {
        let o = self.object_from_camera.translation.vector;
        let c = self.ray(u, v);
        let du = self.ray(u + 0.5, v) - self.ray(u - 0.5, v);
        let dv = self.ray(u, v + 0.5) - self.ray(u, v - 0.5);
        let (mut back, mut grey, mut cover, mut depth) = (0.0, 0.0, 0.0, f64::INFINITY);
        for k in 0..side * side {
            let (a, b) = ((k % side) as f64, (k / side) as f64);
            let n = side as f64;
            // Each row of samples is shifted, so that no straight edge coincides with a column of them.
            let a = (a + 0.5 + (b + 0.5) / n - 0.5) / n - 0.5;
            let b = (b + 0.5) / n - 0.5;
            let d = (self.object_from_camera.rotation * (c + du * a + dv * b)).normalize();
            back += self.stage.backdrop(&o, &d).0;
            if let Some((t, g, _)) = self.stage.valve(&o, &d) {
                grey += g;
                cover += 1.0;
                depth = depth.min(t);
            }
        }
        let n = (side * side) as f64;
        ((back / n) as f32, [(grey / n) as f32, (cover / n) as f32, depth as f32])
    }
}

/// Blurs an image with rows of `width` pixels in place by a symmetric kernel (centre first); border pixels are
/// repeated.
pub(super) fn blur(image: &mut [f32], width: usize, kernel: &[f32], scratch: &mut Vec<f32>) {
    let n = kernel.len() - 1;
    if n == 0 || width == 0 {
        return;
    }
    let height = image.len() / width;
    // Rows, each through a padded copy.
    scratch.clear();
    scratch.resize(width + 2 * n, 0.0);
    for row in image.chunks_exact_mut(width) {
        scratch[..n].fill(row[0]);
        scratch[n..n + width].copy_from_slice(row);
        scratch[n + width..].fill(row[width - 1]);
        for (x, o) in row.iter_mut().enumerate() {
            *o = kernel[0] * scratch[x + n];
        }
        for (k, c) in kernel.iter().enumerate().skip(1) {
            let (a, b) = (&scratch[n - k..], &scratch[n + k..]);
            for ((o, a), b) in row.iter_mut().zip(a).zip(b) {
                *o += c * (a + b);
            }
        }
    }
    // Columns, processed row by row from a copy of the image.
    scratch.clear();
    scratch.extend_from_slice(image);
    for y in 0..height {
        let out = &mut image[y * width..(y + 1) * width];
        let src = |y: isize| {
            let y = y.clamp(0, height as isize - 1) as usize;
            &scratch[y * width..(y + 1) * width]
        };
        for (o, a) in out.iter_mut().zip(src(y as isize)) {
            *o = kernel[0] * a;
        }
        for (k, c) in kernel.iter().enumerate().skip(1) {
            let (a, b) = (src(y as isize - k as isize), src(y as isize + k as isize));
            for ((o, a), b) in out.iter_mut().zip(a).zip(b) {
                *o += c * (a + b);
            }
        }
    }
}
