//! The fixed scene: valve, pipe, wall and light, and the grey value seen along a ray.

use super::wheel::{Part, Wheel};
use graspd_rt::geom::Vec3;
use serde::{Deserialize, Serialize};

/// The fixed part of the scene, in the object frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stage {
    /// The valve.
    pub wheel: Wheel,
    /// Radius of the pipe the stem stands on, metres.
    pub pipe_radius_m: f64,
    /// Direction of the pipe in the plane of the wheel, rad from x.
    pub pipe_angle_rad: f64,
    /// Distance of the wall behind the origin, metres.
    pub wall_m: f64,
    /// Bolts and holes on the wall, which resemble marks: `[x, y, radius]` metres, dark ones with a positive radius.
    pub bolts_m: Vec<[f64; 3]>,
    /// Albedo of paint, rim, hub, pipe and wall, 0 to 1.
    pub albedo: [f64; 5],
    /// Unit vector towards the light.
    pub light: [f64; 3],
    /// Fraction of ambient light.
    pub ambient: f64,
    /// Fraction of directional light.
    pub diffuse: f64,
    /// Amplitude of the wall's texture as a fraction of its grey value.
    pub texture: f64,
    /// Grey value of a fully lit white surface.
    pub white: f64,
}

/// The object that a ray hits; a change between neighbouring pixels requires supersampling.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Thing {
    /// A part of the valve.
    Valve(Part),
    /// The pipe.
    Pipe,
    /// A bolt.
    Bolt,
    /// The wall.
    Wall,
    /// No object.
    Void,
}

impl Stage {
    fn light(&self) -> Vec3 {
        Vec3::from(self.light)
    }

    /// Grey value of a matt surface; `lit` is the fraction of direct light that reaches it.
    pub fn shade(&self, albedo: f64, normal: &Vec3, lit: f64) -> f64 {
        self.white * albedo * (self.ambient + self.diffuse * lit * normal.dot(&self.light()).max(0.0))
    }

    /// First hit on the valve: distance, grey value, part.
    pub fn valve(&self, o: &Vec3, d: &Vec3) -> Option<(f64, f64, Thing)> {
        let (t, part, mut n) = self.wheel.trace(o, d)?;
        if n.dot(d) > 0.0 {
            n = -n;
        }
        let albedo = match part {
            Part::Paint => self.albedo[0],
            Part::Rim | Part::Spoke => self.albedo[1],
            Part::Hub => self.albedo[2],
            Part::Cover => 0.45,
        };
        let p = o + d * t;
        let lit = if part == Part::Cover { 1.0 } else { self.lit(&(p + n * 2e-4)) };
        let mut grey = self.shade(albedo, &n, lit);
        // Specular highlight of the varnish.
        let half = (self.light() - d).try_normalize(0.0).unwrap_or(n);
        if part != Part::Cover {
            grey += self.white * 0.12 * lit * self.diffuse * n.dot(&half).max(0.0).powi(24);
        }
        Some((t, grey, Thing::Valve(part)))
    }

    /// Grey value and object behind the valve.
    pub fn backdrop(&self, o: &Vec3, d: &Vec3) -> (f64, Thing) {
        if let Some((t, n)) = self.pipe(o, d) {
            let p = o + d * t;
            return (self.shade(self.albedo[3], &n, self.lit(&(p + n * 2e-4))), Thing::Pipe);
        }
        let t = (-self.wall_m - o.z) / d.z;
        if !(t > 0.0 && t < 1e3) {
            return (self.white * 0.05, Thing::Void);
        }
        let p = o + d * t;
        let n = Vec3::z();
        for b in &self.bolts_m {
            if (p.x - b[0]).powi(2) + (p.y - b[1]).powi(2) < b[2] * b[2] {
                return (self.shade(if b[2] > 0.0 { 0.09 } else { 0.85 }, &n, self.lit(&p)), Thing::Bolt);
            }
        }
        let albedo = self.albedo[4] * (1.0 + self.texture * texture(p.x, p.y));
        (self.shade(albedo, &n, self.lit(&p)), Thing::Wall)
    }

    fn pipe(&self, o: &Vec3, d: &Vec3) -> Option<(f64, Vec3)> {
        let axis = Vec3::new(self.pipe_angle_rad.cos(), self.pipe_angle_rad.sin(), 0.0);
        let c = Vec3::new(0.0, 0.0, self.wheel.core_z() - self.wheel.stem_m);
        let across = |v: &Vec3| v - axis * v.dot(&axis);
        let (oo, dd) = (across(&(o - c)), across(d));
        let (a, b) = (dd.norm_squared(), oo.dot(&dd));
        let disc = b * b - a * (oo.norm_squared() - self.pipe_radius_m * self.pipe_radius_m);
        if a < 1e-12 || disc < 0.0 {
            return None;
        }
        let t = (-b - disc.sqrt()) / a;
        (t > 0.0).then(|| (t, (oo + dd * t) / self.pipe_radius_m))
    }

    /// Fraction of direct light at a point: shadows of valve and pipe, with a penumbra from the distance to the
    /// occluder.
    fn lit(&self, p: &Vec3) -> f64 {
        let l = self.light();
        if self.pipe(p, &l).is_some_and(|(t, _)| t > 1e-3) {
            return 0.0;
        }
        let b = self.wheel.bounding_radius();
        let along = -p.dot(&l);
        let miss2 = p.norm_squared() - along * along;
        if miss2 > b * b {
            return 1.0;
        }
        let end = along + (b * b - miss2).sqrt();
        let mut lit = 1.0f64;
        let core_z = self.wheel.core_z();
        let mut t = (along - (b * b - miss2).sqrt()).max(1e-3);
        for _ in 0..48 {
            if t >= end {
                break;
            }
            let (s, _) = self.wheel.distance_above(&(p + l * t), core_z);
            if s < 1e-5 {
                return 0.0;
            }
            lit = lit.min(14.0 * s / t);
            t += s.max(4e-4);
        }
        lit.clamp(0.0, 1.0)
    }
}

/// Texture of the wall: smooth noise from -1 to 1 with features of a few centimetres.
fn texture(x: f64, y: f64) -> f64 {
    let octave = |x: f64, y: f64| {
        let (i, j) = (x.floor(), y.floor());
        let s = |t: f64| t * t * (3.0 - 2.0 * t);
        let (u, v) = (s(x - i), s(y - j));
        let h = |a: f64, b: f64| {
            let k = (a as i64 as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15)
                ^ (b as i64 as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
            let k = (k ^ (k >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            ((k ^ (k >> 32)) & 0xffff) as f64 / 32767.5 - 1.0
        };
        let top = h(i, j) * (1.0 - u) + h(i + 1.0, j) * u;
        let bottom = h(i, j + 1.0) * (1.0 - u) + h(i + 1.0, j + 1.0) * u;
        top * (1.0 - v) + bottom * v
    };
    0.6 * octave(9.0 * x, 9.0 * y) + 0.4 * octave(41.0 * x + 7.3, 41.0 * y + 1.9)
}
