//! Synthetic recordings with ground truth: a converging rig 1.5 m from a gripper with eight marks, modelled on the
//! generator of the public data sets.

use crate::calibrate::gripper::data::{ArmPose, Noise, Recording, Sighting, Sigma};
use crate::calibrate::gripper::rig_prior::{RigChange, RigDeviations, RigPrior, moved};
use crate::calibrate::gripper::{Solution, calibrate};
use graspd_rt::geom::{Camera, Distortion, Pixel, Pose, Rig, Vec3, View};
use nalgebra::{DMatrix, DVector, Matrix3, Rotation3, Translation3, UnitQuaternion};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Parameters of a synthetic world.
#[derive(Clone, Copy, Debug)]
pub(super) struct WorldSpec {
    pub(super) seed: u64,
    pub(super) poses: usize,
    /// Maximum rotation of a pose from the one that faces the rig, degrees.
    pub(super) turn_deg: f64,
    pub(super) outliers: f64,
    pub(super) marks_m: f64,
    /// The reported rig has errors drawn from the default standard deviations.
    pub(super) rig_off: bool,
    /// Axes of the poses' rotations, in the flange's frame; any axis if `None`.
    pub(super) axes: Option<&'static [usize]>,
}

impl Default for WorldSpec {
    fn default() -> Self {
        Self { seed: 1, poses: 30, turn_deg: 60.0, outliers: 0.0, marks_m: 0.0, rig_off: false, axes: None }
    }
}

/// A recording and its ground truth.
pub(super) struct World {
    pub(super) rec: Recording,
    pub(super) x: Pose,
    pub(super) y: Pose,
    pub(super) marks: Vec<Vec3>,
    pub(super) rig: Rig,
    /// Poses that are not in the recording, for evaluation.
    pub(super) fresh: Vec<Pose>,
}

pub(super) struct Draw(ChaCha8Rng);

impl Draw {
    pub(super) fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    pub(super) fn normal(&mut self, sd: f64) -> f64 {
        let v: f64 = StandardNormal.sample(&mut self.0);
        sd * v
    }

    fn three(&mut self, sd: f64) -> Vec3 {
        Vec3::from_fn(|_, _| self.normal(sd))
    }

    pub(super) fn uniform(&mut self, lo: f64, hi: f64) -> f64 {
        self.0.random_range(lo..hi)
    }

    fn pose(&mut self, m: f64, rad: f64) -> Pose {
        Pose::from_parts(Translation3::from(self.three(m)), UnitQuaternion::from_scaled_axis(self.three(rad)))
    }
}

fn rig(d: &mut Draw) -> Rig {
    let camera = |d: &mut Draw| {
        let f = 1250.0 + d.normal(15.0);
        let distortion = Distortion {
            k1: -0.11 + d.normal(0.01),
            k2: 0.09 + d.normal(0.01),
            p1: d.normal(3e-4),
            p2: d.normal(3e-4),
            ..Default::default()
        };
        let (fy, cx, cy) = (f + d.normal(1.0), 640.0 + d.normal(8.0), 512.0 + d.normal(8.0));
        Camera { width: 1280, height: 1024, fx: f, fy, cx, cy, distortion }
    };
    let (left, right) = (camera(d), camera(d));
    let turn = UnitQuaternion::from_scaled_axis(Vec3::new(d.normal(0.01), -0.18 + d.normal(0.01), d.normal(0.01)));
    let centre = Vec3::new(0.3 + d.normal(5e-3), d.normal(3e-3), d.normal(3e-3));
    Rig { left, right, right_from_left: Pose::from_parts(Translation3::from(-(turn * centre)), turn) }
}

impl World {
    pub(super) fn new(w: WorldSpec) -> Self {
        let mut d = Draw::new(w.seed);
        let rig = rig(&mut d);
        let target = Vec3::new(0.5, 0.0, 0.35) + d.three(0.02);
        let z = (UnitQuaternion::from_scaled_axis(d.three(0.1)) * Vec3::new(-0.8, 0.25, -0.5)).normalize();
        let x = z.cross(&Vec3::z()).normalize();
        let axes = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, z.cross(&x), z]));
        let turn = UnitQuaternion::from_rotation_matrix(&axes);
        let y = Pose::from_parts(Translation3::from(target - z * 1.5 - x * 0.12), turn);
        let place = Vec3::new(d.normal(0.02), d.normal(0.02), 0.13 + d.normal(0.01));
        let x = Pose::from_parts(Translation3::from(place), UnitQuaternion::from_scaled_axis(d.three(0.6)));
        let base = [
            [-40, -35, 5],
            [40, -35, 0],
            [40, 35, 8],
            [-40, 35, 2],
            [0, -20, 30],
            [25, 10, 25],
            [-25, 15, 35],
            [5, 40, 18],
        ];
        let marks: Vec<Vec3> =
            base.iter().map(|m| Vec3::from_fn(|r, _| 1e-3 * (f64::from(m[r]) + d.uniform(-3.0, 3.0)))).collect();
        let mut world = Self { rec: recording(rig, &marks, w, &mut d), x, y, marks, rig, fresh: Vec::new() };
        for _ in 0..w.poses {
            let flange = world.flange(target, w, &mut d);
            let seen = world.seen(&flange, w, &mut d);
            let reported = flange * d.pose(1e-4, 0.02_f64.to_radians());
            world.rec.poses.push(ArmPose {
                base_from_flange: reported,
                base_from_tcp: None,
                joints: None,
                marks: seen,
            });
        }
        let all = WorldSpec { axes: None, ..w };
        world.fresh = (0..40).map(|_| world.flange(target, all, &mut d)).collect();
        world
    }

    /// A flange pose with all marks visible in both images.
    fn flange(&self, target: Vec3, w: WorldSpec, d: &mut Draw) -> Pose {
        loop {
            let angle = d.uniform(5.0, w.turn_deg).to_radians();
            let sign = if d.uniform(0.0, 1.0) < 0.5 { -1.0 } else { 1.0 };
            let axis = d.three(1.0).normalize();
            let place = target + Vec3::new(d.uniform(-0.18, 0.18), d.uniform(-0.22, 0.22), d.uniform(-0.16, 0.16));
            let facing = self.y.rotation * UnitQuaternion::from_scaled_axis(Vec3::x() * std::f64::consts::PI);
            let gripper = match w.axes {
                None => {
                    Pose::from_parts(Translation3::from(place), facing * UnitQuaternion::from_scaled_axis(axis * angle))
                }
                // Rotations about the flange's own axes, from the flange pose that faces the rig.
                Some(axes) => {
                    let k = axes[(d.uniform(0.0, axes.len() as f64)) as usize % axes.len()];
                    let mut axis = Vec3::zeros();
                    axis[k] = sign * angle;
                    let flange = facing * self.x.rotation.inverse() * UnitQuaternion::from_scaled_axis(axis);
                    Pose::from_parts(Translation3::from(place), flange * self.x.rotation)
                }
            };
            let flange = gripper * self.x.inverse();
            let inside = |m: &Vec3| {
                View::BOTH
                    .iter()
                    .all(|v| self.pixel(*v, &flange, m).is_some_and(|p| self.rig.camera(*v).contains(p, 15.0)))
            };
            if self.marks.iter().all(inside) {
                return flange;
            }
        }
    }

    fn pixel(&self, view: View, flange: &Pose, mark: &Vec3) -> Option<Pixel> {
        let x = self.y.inv_mul(flange) * self.x * nalgebra::Point3::from(*mark);
        self.rig.project(view, &x.coords)
    }

    fn seen(&self, flange: &Pose, w: WorldSpec, d: &mut Draw) -> Vec<Sighting> {
        let mut out = Vec::new();
        for (mark, m) in self.marks.iter().enumerate() {
            let mut px = [None; 2];
            for v in View::BOTH {
                let hidden = d.uniform(0.0, 1.0) < 0.08;
                let Some(mut p) = self.pixel(v, flange, m).filter(|_| !hidden) else { continue };
                p += Pixel::new(d.normal(0.2), d.normal(0.2));
                if d.uniform(0.0, 1.0) < w.outliers {
                    p += Pixel::new(d.uniform(-40.0, 40.0), d.uniform(-40.0, 40.0));
                }
                px[v.index()] = Some(p);
            }
            out.push(Sighting { mark, px });
        }
        out
    }

    pub(super) fn solve(&self) -> Solution {
        calibrate(&self.rec, 1e-3).unwrap()
    }

    /// Root mean square error of the marks predicted at the fresh poses: metres in the left camera, pixels.
    pub(super) fn predicted(&self, s: &Solution) -> [f64; 2] {
        let (mut m2, mut p2, mut n) = (0.0, 0.0, 0.0);
        for flange in &self.fresh {
            for (m, mt) in s.marks.iter().zip(&self.marks) {
                let own =
                    (s.base_from_left.inv_mul(flange) * s.flange_from_gripper * nalgebra::Point3::from(*m)).coords;
                let truth = (self.y.inv_mul(flange) * self.x * nalgebra::Point3::from(*mt)).coords;
                m2 += (own - truth).norm_squared();
                for v in View::BOTH {
                    let (a, b) = (s.rig.project(v, &own).unwrap(), self.rig.project(v, &truth).unwrap());
                    p2 += 0.5 * (a - b).norm_squared();
                }
                n += 1.0;
            }
        }
        [(m2 / n).sqrt(), (p2 / n).sqrt()]
    }

    /// Squared Mahalanobis error of poses and marks under the reported covariance, divided by the degrees of freedom.
    pub(super) fn normalized(&self, s: &Solution) -> f64 {
        let n = 12 + s.mark_unknowns();
        let mut e = DVector::zeros(n);
        for (at, own, truth) in [(0, s.flange_from_gripper, self.x), (6, s.base_from_left, self.y)] {
            let d = graspd_rt::geom::log_pose(&own.inv_mul(&truth));
            (0..6).for_each(|k| e[at + k] = d[k]);
        }
        for k in 0..s.mark_unknowns() / 3 {
            (0..3).for_each(|a| e[12 + 3 * k + a] = (self.marks[k] - s.marks[k])[a]);
        }
        let sd = DVector::from_fn(n, |i, _| s.covariance[(i, i)].sqrt());
        let r = DMatrix::from_fn(n, n, |i, j| s.covariance[(i, j)] / (sd[i] * sd[j]));
        let e = e.component_div(&sd);
        e.dot(&r.cholesky().unwrap().solve(&e)) / n as f64
    }
}

fn recording(rig: Rig, marks: &[Vec3], w: WorldSpec, d: &mut Draw) -> Recording {
    let stated = |value| Sigma { value, stated: true };
    let noise = Noise {
        flange_m: stated(1e-4),
        flange_rad: stated(0.02_f64.to_radians()),
        mark_px: stated(0.2),
        marks_m: stated(w.marks_m),
        outliers: w.outliers,
    };
    let nominal: Vec<Vec3> = marks.iter().map(|m| m + d.three(w.marks_m)).collect();
    let reported = if w.rig_off {
        let prior = RigPrior::from_deviations(&RigDeviations::default(), &rig);
        let u = DVector::from_fn(prior.unknowns(), |_, _| d.normal(1.0));
        moved(&rig, &RigChange::from_column_slice((&prior.factor * u).as_slice()))
    } else {
        rig
    };
    Recording {
        name: "synthetic".into(),
        rig: reported,
        rig_prior: None,
        marks: nominal,
        noise,
        poses: Vec::new(),
        assumed: None,
    }
}
