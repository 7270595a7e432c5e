//! The valve: a torus with spokes, hub and stem and an optional painted circle on its crest; rendered by sphere
//! tracing.
//!
//! Everything is in the object frame, z along the valve's axis towards the cameras. With a painted band the origin is
//! at the centre of the plane of the band's two edges, which are the circles that a camera sees. Without one it is at
//! the centre of the bar's core circle.

use graspd_rt::geom::Vec3;

/// Shape of a hand wheel.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Wheel {
    /// Radius R of the bar's core circle, metres.
    pub core_radius_m: f64,
    /// Radius r of the bar, metres.
    pub bar_radius_m: f64,
    /// Width of the painted band on the crest, metres; 0 for a bare wheel.
    pub paint_width_m: f64,
    /// Number of spokes.
    pub spokes: u32,
    /// Angle of the first spoke from the x axis, rad.
    pub spoke_angle_rad: f64,
    /// Length of the stem from the hub down to the pipe's axis, metres.
    pub stem_m: f64,
    /// Occluded part of the rim: first angle and extent, rad; extent 0 for none.
    pub hidden_rad: [f64; 2],
}

/// A part of the valve.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// The bar of the rim.
    Rim,
    /// The painted band.
    Paint,
    /// Spokes.
    Spoke,
    /// Hub and stem.
    Hub,
    /// The sheet that occludes a part of the rim.
    Cover,
}

impl Wheel {
    /// Half the tube angle covered by the paint, rad.
    fn paint_half_angle(&self) -> f64 {
        (0.5 * self.paint_width_m / self.bar_radius_m).min(1.2)
    }

    /// z of the core circle's plane in the object frame, metres; negative if it is behind the origin.
    pub fn core_z(&self) -> f64 {
        if self.paint_width_m > 0.0 { -self.bar_radius_m * self.paint_half_angle().cos() } else { 0.0 }
    }

    /// Radii of the inner and outer edge of the painted band, which are in the plane z = 0, metres; `None` without
    /// paint.
    pub fn paint_radii(&self) -> Option<[f64; 2]> {
        (self.paint_width_m > 0.0).then(|| {
            let d = self.bar_radius_m * self.paint_half_angle().sin();
            [self.core_radius_m - d, self.core_radius_m + d]
        })
    }

    /// Outermost radius of the rim, metres.
    pub fn outer_radius(&self) -> f64 {
        self.core_radius_m + self.bar_radius_m
    }

    fn spoke_radius(&self) -> f64 {
        0.55 * self.bar_radius_m
    }

    /// Radius of the hub, metres.
    pub fn hub_radius(&self) -> f64 {
        (0.24 * self.core_radius_m).max(1.4 * self.bar_radius_m)
    }

    /// Lower bound of the signed distance to the valve, metres, and the nearest part.
    pub fn distance(&self, p: &Vec3) -> (f64, Part) {
        self.distance_above(p, self.core_z())
    }

    /// [`Self::distance`] with a precomputed `core_z`.
    pub(super) fn distance_above(&self, p: &Vec3, core_z: f64) -> (f64, Part) {
        // A plain square root: f64::hypot would cost more than the rest of this function.
        let length = |a: f64, b: f64| (a * a + b * b).sqrt();
        let (rc, rb) = (self.core_radius_m, self.bar_radius_m);
        let z = p.z - core_z;
        let rho = length(p.x, p.y);
        let mut best = (length(rho - rc, z) - rb, Part::Rim);
        let mut take = |d: f64, part: Part| {
            if d < best.0 {
                best = (d, part);
            }
        };
        let cylinder = |r: f64, z0: f64, z1: f64| {
            let (dr, dz) = (rho - r, (z0 - z).max(z - z1));
            dr.max(dz).min(0.0) + length(dr.max(0.0), dz.max(0.0))
        };
        take(cylinder(self.hub_radius(), -1.6 * rb, 0.5 * rb), Part::Hub);
        take(cylinder(0.45 * self.hub_radius(), -self.stem_m, 0.9 * rb), Part::Hub);
        // The angle to the nearest spoke is needed only where a spoke can be nearer than `best`.
        let height = z + 0.25 * rb;
        let least = length(height, (rho - rc).max(0.0)) - self.spoke_radius();
        if self.spokes > 0 && least < best.0 {
            let step = std::f64::consts::TAU / f64::from(self.spokes);
            let a = p.y.atan2(p.x) - self.spoke_angle_rad;
            let (sin, cos) = (a - step * (a / step).round()).sin_cos();
            let (along, across) = (rho * cos, rho * sin);
            let beyond = (along - rc).max(-along).max(0.0);
            let d = length(length(across, height), beyond) - self.spoke_radius();
            if d < best.0 {
                best = (d, Part::Spoke);
            }
        }
        best
    }

    /// Radius of a sphere about the origin that contains rim, hub and cover.
    pub fn bounding_radius(&self) -> f64 {
        let cover = if self.hidden_rad[1] > 0.0 { self.core_radius_m + 3.0 * self.bar_radius_m } else { 0.0 };
        self.outer_radius().max(cover).hypot(2.2 * self.bar_radius_m).max(self.stem_m + 0.01)
    }

    /// First hit of a ray (origin, unit direction): distance, part and outward unit normal.
    pub fn trace(&self, o: &Vec3, d: &Vec3) -> Option<(f64, Part, Vec3)> {
        let b = self.bounding_radius();
        let along = -o.dot(d);
        let miss2 = o.norm_squared() - along * along;
        if miss2 > b * b {
            return None;
        }
        let half = (b * b - miss2).sqrt();
        let (mut t, end) = ((along - half).max(0.0), along + half);
        let cover = self.trace_cover(o, d);
        let core_z = self.core_z();
        for _ in 0..128 {
            let p = o + d * t;
            let (s, part) = self.distance_above(&p, core_z);
            if s < 2e-6 {
                if let Some(c) = cover.filter(|c| *c < t) {
                    return Some((c, Part::Cover, Vec3::new(0.0, 0.0, 1.0)));
                }
                let n = self.normal(&p, core_z);
                let part = if part == Part::Rim && self.is_painted(&p) { Part::Paint } else { part };
                return Some((t, part, n));
            }
            t += s;
            if t > end {
                break;
            }
        }
        cover.map(|c| (c, Part::Cover, Vec3::new(0.0, 0.0, 1.0)))
    }

    /// Whether a point of the rim is painted.
    fn is_painted(&self, p: &Vec3) -> bool {
        if self.paint_width_m <= 0.0 {
            return false;
        }
        let v = (p.x.hypot(p.y) - self.core_radius_m).atan2(p.z - self.core_z());
        v.abs() < self.paint_half_angle()
    }

    fn normal(&self, p: &Vec3, core_z: f64) -> Vec3 {
        let h = 1e-6;
        let mut n = Vec3::zeros();
        for k in 0..3 {
            let mut e = Vec3::zeros();
            e[k] = h;
            n[k] = self.distance_above(&(p + e), core_z).0 - self.distance_above(&(p - e), core_z).0;
        }
        n.try_normalize(0.0).unwrap_or_else(Vec3::z)
    }

    /// Hit on the flat sheet in front of a part of the rim.
    fn trace_cover(&self, o: &Vec3, d: &Vec3) -> Option<f64> {
        let [first, extent] = self.hidden_rad;
        if extent <= 0.0 || d.z.abs() < 1e-9 {
            return None;
        }
        let z = self.core_z() + 1.3 * self.bar_radius_m;
        let t = (z - o.z) / d.z;
        let p = o + d * t;
        let rho = p.x.hypot(p.y);
        let (lo, hi) = (self.core_radius_m - 1.8 * self.bar_radius_m, self.core_radius_m + 3.0 * self.bar_radius_m);
        let a = (p.y.atan2(p.x) - first).rem_euclid(std::f64::consts::TAU);
        (t > 0.0 && rho > lo && rho < hi && a < extent).then_some(t)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wheel(paint: f64) -> Wheel {
        Wheel {
            core_radius_m: 0.05,
            bar_radius_m: 0.008,
            paint_width_m: paint,
            spokes: 3,
            spoke_angle_rad: 0.3,
            stem_m: 0.06,
            hidden_rad: [0.0; 2],
        }
    }

    #[test]
    fn rays_parallel_to_the_axis_hit_the_crest_at_its_height() {
        for paint in [0.0, 0.006] {
            let w = wheel(paint);
            for k in 0..40 {
                let a = 0.157 * f64::from(k);
                let o = Vec3::new(0.05 * a.cos(), 0.05 * a.sin(), 1.0);
                let (t, part, n) = w.trace(&o, &-Vec3::z()).unwrap();
                assert!((1.0 - t - (w.core_z() + 0.008)).abs() < 1e-5);
                assert_eq!(part, if paint > 0.0 { Part::Paint } else { Part::Rim });
                assert!(n.z > 0.9999);
            }
        }
    }

    #[test]
    fn the_paint_ends_on_circles_in_the_plane_of_the_origin() {
        let w = wheel(0.006);
        let [inner, outer] = w.paint_radii().unwrap();
        for (r, painted) in [(inner + 1e-5, true), (inner - 1e-5, false), (outer - 1e-5, true), (outer + 1e-5, false)] {
            // Between two spokes.
            let a: f64 = 0.3 + 1.0;
            let o = Vec3::new(r * a.cos(), r * a.sin(), 1.0);
            let (t, part, _) = w.trace(&o, &-Vec3::z()).unwrap();
            assert!((1.0 - t).abs() < 2e-5, "height {}", 1.0 - t);
            assert_eq!(part == Part::Paint, painted, "{r}");
        }
    }

    #[test]
    fn the_distance_never_oversteps() {
        let w = wheel(0.006);
        for k in 0..3000u32 {
            let f = |m: f64| (f64::from(k) * m).sin() * 0.09;
            let (a, b) = (Vec3::new(f(0.71), f(1.37), f(2.11)), Vec3::new(f(0.53), f(1.91), f(2.71)));
            let (da, db) = (w.distance(&a).0, w.distance(&b).0);
            assert!((da - db).abs() <= (a - b).norm() * 1.0001 + 1e-9, "{a} {b}");
        }
    }
}
