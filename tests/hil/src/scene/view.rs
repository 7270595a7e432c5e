//! The image of one camera: fixed layers, gripper, sensor.

use super::body::Body;
use super::layers::{Layers, blur};
use super::raster::{Coverage, Rect};
use super::sensor::{Noise, SCALE, Sensor, expose};
use super::solid::{Solid, paint_order, project};
use super::stage::Stage;
use graspd_rt::geom::{Camera, Pixel, Pose, Vec3};
use nalgebra::Point3;

/// Corners of the polygon that approximates a disc; its radius is enlarged to match the disc's area.
const DISC_CORNERS: usize = 96;

/// Renders one view; keeps its buffers.
#[derive(Debug)]
pub struct ViewRenderer {
    camera: Camera,
    camera_from_object: Pose,
    layers: Layers,
    sensor: Sensor,
    kernel: Vec<f32>,
    work: Work,
}

#[derive(Debug, Default)]
struct Work {
    coverage: Coverage,
    scratch: [Vec<Vec3>; 2],
    outline: Vec<Pixel>,
    /// The gripper in its rectangle: grey value times coverage, coverage, distance along the ray.
    gripper: Vec<[f32; 3]>,
    /// One solid: grey value times coverage, coverage.
    solid: Vec<[f32; 2]>,
    image: Vec<f32>,
    blur: Vec<f32>,
    row: (Vec<i16>, Vec<i16>),
}

/// The moving part of one image.
#[derive(Clone, Copy, Debug)]
pub struct Moving<'a> {
    /// The gripper.
    pub body: &'a Body,
    /// Its pose.
    pub object_from_gripper: Pose,
    /// Distance between the jaws, metres.
    pub opening: f64,
    /// Marks painted over with their surroundings, by bit (a fault).
    pub hidden_marks: u32,
}

impl ViewRenderer {
    /// Renders the fixed layers of a view.
    pub fn new(stage: &Stage, camera: Camera, camera_from_object: Pose, sensor: Sensor) -> Self {
        let layers = Layers::render(stage, &camera, &camera_from_object, &sensor);
        Self { camera, camera_from_object, layers, sensor, kernel: sensor.kernel(), work: Work::default() }
    }

    /// The camera.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The image without noise and gripper: the average of many exposures.
    pub fn still(&self) -> Vec<u8> {
        self.layers.exposed.0.iter().map(|v| ((v + 32) >> 6).clamp(0, 255) as u8).collect()
    }

    /// Draws one image into rows of `stride` bytes. Equal `frame` numbers give equal noise.
    pub fn draw(
        &mut self,
        stage: &Stage,
        moving: Option<Moving<'_>>,
        noise: &Noise,
        frame: u64,
        dst: &mut [u8],
        stride: usize,
    ) {
        let region = moving.and_then(|m| self.draw_gripper(stage, &m));
        let (w, h) = (self.layers.width, self.layers.height);
        let (value, amplitude) = &self.layers.exposed;
        for (y, row) in dst.chunks_mut(stride).take(h).enumerate() {
            let Some(row) = row.get_mut(..w) else { break };
            let numbers = noise.row(frame.wrapping_mul(2048).wrapping_add(y as u64), w);
            let here = y * w..(y + 1) * w;
            let (v, a) = (&value[here.clone()], &amplitude[here]);
            match region {
                Some((r, inner)) if (inner.y0..inner.y1).contains(&y) => {
                    let (x0, x1) = (inner.x0, inner.x1);
                    expose(&mut row[..x0], &v[..x0], &a[..x0], &numbers[..x0]);
                    expose(&mut row[x1..], &v[x1..], &a[x1..], &numbers[x1..]);
                    let at = (y - r.y0) * r.width();
                    let src = &self.work.image[at + x0 - r.x0..at + x1 - r.x0];
                    let (rv, ra) = &mut self.work.row;
                    rv.clear();
                    rv.extend(src.iter().map(|g| (g * SCALE).clamp(0.0, 20_000.0) as i16));
                    ra.clear();
                    ra.extend(src.iter().map(|g| self.sensor.amplitude(*g)));
                    expose(&mut row[x0..x1], rv, ra, &numbers[x0..x1]);
                }
                _ => expose(row, v, a, numbers),
            }
        }
    }

    /// Draws the gripper over the fixed layers and blurs. Returns the rectangle held by `work.image`, and the part of
    /// it in which the blur is correct (at its border neighbouring pixels were missing).
    fn draw_gripper(&mut self, stage: &Stage, m: &Moving<'_>) -> Option<(Rect, Rect)> {
        let (w, h) = (self.layers.width, self.layers.height);
        let camera_from_gripper = self.camera_from_object * m.object_from_gripper;
        let n = self.kernel.len() as f64;
        let solids: Vec<Solid> = m.body.solids.iter().map(|s| s.moved(&camera_from_gripper, m.opening)).collect();
        // Bounding rectangle of all outlines.
        let mut bounds: Option<Rect> = None;
        let work = &mut self.work;
        for f in solids.iter().flat_map(|s| &s.faces).filter(|f| faces_camera(&f.normal, &f.corners)) {
            project(&self.camera, &f.corners, 1, &mut work.scratch, &mut work.outline);
            if let Some(r) = Rect::around(work.outline.iter().copied(), 2.0 * n + 2.0, w, h) {
                bounds = Some(bounds.map_or(r, |b| b.union(&r)));
            }
        }
        let region = bounds?;
        let rw = region.width();
        work.gripper.clear();
        work.gripper.resize(rw * region.height(), [0.0, 0.0, f32::INFINITY]);
        for k in paint_order(&solids) {
            draw_solid(
                &self.camera,
                &self.camera_from_object,
                stage,
                m,
                &camera_from_gripper,
                &solids[k],
                region,
                work,
                &self.layers,
            );
        }
        // The nearer one of valve and gripper is composed over the other, both over the backdrop.
        work.image.clear();
        for y in region.y0..region.y1 {
            let g = &work.gripper[(y - region.y0) * rw..(y - region.y0 + 1) * rw];
            let at = y * w + region.x0;
            let (back, fall) = (&self.layers.backdrop[at..at + rw], &self.layers.falloff[at..at + rw]);
            for (i, ((g, b), f)) in g.iter().zip(back).zip(fall).enumerate() {
                let grey = g[0] * f;
                work.image.push(match self.layers.valve_at(region.x0 + i, y) {
                    Some((v, _)) if v[1] > 0.0 => {
                        if v[2] < g[2] {
                            v[0] + (1.0 - v[1]) * (grey + (1.0 - g[1]) * b)
                        } else {
                            grey + (1.0 - g[1]) * (v[0] + (1.0 - v[1]) * b)
                        }
                    }
                    _ => grey + (1.0 - g[1]) * b,
                });
            }
        }
        blur(&mut work.image, rw, &self.kernel, &mut work.blur);
        let n = self.kernel.len() - 1;
        let inner = Rect {
            x0: if region.x0 == 0 { 0 } else { region.x0 + n },
            y0: if region.y0 == 0 { 0 } else { region.y0 + n },
            x1: if region.x1 == w { w } else { region.x1 - n },
            y1: if region.y1 == h { h } else { region.y1 - n },
        };
        (inner.x0 < inner.x1 && inner.y0 < inner.y1).then_some((region, inner))
    }
}

/// Whether a face (camera frame) faces the camera at the origin.
fn faces_camera(normal: &Vec3, corners: &[Vec3]) -> bool {
    corners.first().is_some_and(|c| normal.dot(c) < 0.0)
}

/// Draws one convex solid with its marks over the farther ones.
#[allow(clippy::too_many_arguments)]
fn draw_solid(
    camera: &Camera,
    camera_from_object: &Pose,
    stage: &Stage,
    m: &Moving<'_>,
    camera_from_gripper: &Pose,
    solid: &Solid,
    region: Rect,
    work: &mut Work,
    layers: &Layers,
) {
    let object_rotation = camera_from_object.rotation.inverse();
    let mut touched: Option<Rect> = None;
    // The visible faces of a convex solid do not overlap, so their coverages add up.
    let rw = region.width();
    work.solid.clear();
    work.solid.resize(rw * region.height(), [0.0; 2]);
    for f in solid.faces.iter().filter(|f| faces_camera(&f.normal, &f.corners)) {
        project(camera, &f.corners, 5, &mut work.scratch, &mut work.outline);
        let grey = stage.shade(solid.albedo, &(object_rotation * f.normal), 1.0) as f32;
        let Some(r) = work.coverage.fill(&work.outline, region) else { continue };
        touched = Some(touched.map_or(r, |t| t.union(&r)));
        let offset = f.corners.first().map_or(0.0, |c| f.normal.dot(c));
        for y in r.y0..r.y1 {
            let at = (y - region.y0) * rw + (r.x0 - region.x0);
            for (i, (s, c)) in work.solid[at..].iter_mut().zip(work.coverage.row(y)).enumerate() {
                s[0] += c * grey;
                s[1] += c;
                // The distance along the ray is needed only where the valve could be in front or behind.
                if *c > 0.0
                    && let Some((v, ray)) = layers.valve_at(r.x0 + i, y)
                    && v[1] > 0.0
                {
                    let t = (offset / f.normal.dot(ray)) as f32;
                    if t > 0.0 && (*c > 0.3 || work.gripper[at + i][2] == f32::INFINITY) {
                        work.gripper[at + i][2] = t;
                    }
                }
            }
        }
    }
    for mark in &solid.marks {
        if m.hidden_marks >> mark & 1 == 1 {
            continue;
        }
        let Some(d) = m.body.marks.get(*mark) else { continue };
        let normal = camera_from_gripper.rotation * d.normal;
        let centre = (camera_from_gripper * Point3::from(d.position)).coords;
        if normal.dot(&centre) >= 0.0 {
            continue;
        }
        disc_outline(camera, &centre, &normal, d.radius, &mut work.outline);
        let grey = stage.shade(m.body.mark_albedo[*mark], &(object_rotation * normal), 1.0) as f32;
        let Some(r) = work.coverage.fill(&work.outline, region) else { continue };
        for y in r.y0..r.y1 {
            let at = (y - region.y0) * rw + (r.x0 - region.x0);
            for (s, c) in work.solid[at..].iter_mut().zip(work.coverage.row(y)) {
                s[0] = s[0] * (1.0 - c) + c * grey * s[1].min(1.0);
            }
        }
    }
    let Some(t) = touched else { return };
    for y in t.y0..t.y1 {
        let at = (y - region.y0) * rw;
        let span = at + t.x0 - region.x0..at + t.x1 - region.x0;
        for (g, s) in work.gripper[span.clone()].iter_mut().zip(&work.solid[span]) {
            let a = s[1].min(1.0);
            g[0] = g[0] * (1.0 - a) + s[0];
            g[1] = g[1] * (1.0 - a) + a;
        }
    }
}

/// Outline of a disc (camera frame) in pixels; empty if a part of it cannot be projected.
pub(super) fn disc_outline(camera: &Camera, centre: &Vec3, normal: &Vec3, radius: f64, out: &mut Vec<Pixel>) {
    out.clear();
    let seed = if normal.x.abs() < 0.7 { Vec3::x() } else { Vec3::y() };
    let u = normal.cross(&seed).normalize();
    let v = normal.cross(&u);
    let step = std::f64::consts::TAU / DISC_CORNERS as f64;
    // The area of an inscribed polygon is smaller than the disc's by the factor sin(step)/step.
    let r = radius * (step / step.sin()).sqrt();
    for k in 0..DISC_CORNERS {
        let (s, c) = (k as f64 * step).sin_cos();
        if let Some(p) = camera.project(&(centre + (u * c + v * s) * r)) {
            out.push(p);
        }
    }
    if out.len() < DISC_CORNERS {
        out.clear();
    }
}
