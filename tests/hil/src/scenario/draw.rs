//! Draws random cells until one satisfies the conditions of a careful integrator.

use super::reach::{line, seen_marks, straight_path};
use super::{Options, STANDOFF_M, Scenario, default_gripper, grasp_pose};
use crate::scene::{Body, Sensor, Stage, Wheel};
use graspd_rt::arm::{Dh, Joints, closed_form};
use graspd_rt::geom::{Camera, Distortion, Pixel, Pose, Rig, Vec3, View};
use nalgebra::{Matrix3, Point3, Rotation3, Translation3, UnitQuaternion};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::f64::consts::{PI, TAU};

/// Cells drawn before giving up; a few dozen suffice in practice.
const MAX_TRIES: usize = 4000;

/// No cell satisfies the conditions.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "no reachable cell for seed {seed} in {MAX_TRIES} tries: the arm or the cameras cannot reach the requested wheel size, tilt \
    or distance; widen these options"
)]
pub struct ScenarioError {
    /// The seed.
    pub seed: u64,
}

impl Scenario {
    /// Draws a cell. Equal seeds and options give equal cells on every machine.
    pub fn from_seed(seed: u64, options: &Options) -> Result<Self, ScenarioError> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        for _ in 0..MAX_TRIES {
            if let Some(s) = attempt(seed, options, &mut rng) {
                return Ok(s);
            }
        }
        Err(ScenarioError { seed })
    }
}

fn within(rng: &mut impl Rng, [lo, hi]: [f64; 2]) -> f64 {
    if hi > lo { rng.random_range(lo..hi) } else { lo }
}

fn sign(rng: &mut impl Rng) -> f64 {
    if rng.random_bool(0.5) { 1.0 } else { -1.0 }
}

fn unit(rng: &mut impl Rng) -> Vec3 {
    let z: f64 = rng.random_range(-1.0..1.0);
    let a = rng.random_range(0.0..TAU);
    let r = (1.0 - z * z).sqrt();
    Vec3::new(r * a.cos(), r * a.sin(), z)
}

/// A rotation whose z column is `z` and whose x column is as close to `x` as possible.
fn frame(z: &Vec3, x: &Vec3) -> UnitQuaternion<f64> {
    let z = z.normalize();
    let x = (x - z * z.dot(x)).try_normalize(1e-6).unwrap_or_else(|| z.cross(&Vec3::new(0.3, 0.5, 0.8)).normalize());
    let m = Matrix3::from_columns(&[x, z.cross(&x), z]);
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(m))
}

fn attempt(seed: u64, o: &Options, rng: &mut ChaCha8Rng) -> Option<Scenario> {
    let wheel = draw_wheel(o, rng);
    // The valve is in front of the arm; its axis points back to the arm and upwards.
    let bearing = rng.random_range(-PI..PI);
    let out = Vec3::new(bearing.cos(), bearing.sin(), 0.0);
    let place = out * rng.random_range(0.45..0.68) + Vec3::z() * rng.random_range(0.12..0.45);
    let up: f64 = rng.random_range(20f64.to_radians()..80f64.to_radians());
    let swing = Rotation3::from_axis_angle(&Vec3::z_axis(), rng.random_range(-0.5..0.5));
    let normal = swing * (-out) * up.cos() + Vec3::z() * up.sin();
    let base_from_object = Pose::from_parts(Translation3::from(place), frame(&normal, &unit(rng)));

    // The rig is at the given distance, at an angle to the axis (tilt) in any direction, but not below the table.
    let tilt = within(rng, o.tilt_deg).to_radians();
    let turn = rng.random_range(-PI..PI);
    let towards = base_from_object.rotation * Vec3::new(tilt.sin() * turn.cos(), tilt.sin() * turn.sin(), tilt.cos());
    if towards.z < -0.1 {
        return None;
    }
    let (base_from_left, true_rig) = draw_rig(o, rng, &place, &towards)?;
    let gripper = default_gripper();
    let body = Body::new(&gripper);
    let given_dh = o.model.dh();
    let true_dh = perturbed(o, rng);
    let (stage, sensor) = draw_stage(o, rng, wheel, &base_from_object, &towards);
    let left_from_object = base_from_left.inverse() * base_from_object;
    let circle = wheel.paint_radii().map_or(wheel.outer_radius(), |r| r[1]);
    let rim_inside = |view: View| {
        (0..24).all(|k| {
            let a = TAU * f64::from(k) / 24.0;
            let p = Point3::new(1.3 * circle * a.cos(), 1.3 * circle * a.sin(), 0.0);
            true_rig
                .project(view, &(left_from_object * p).coords)
                .is_some_and(|p| true_rig.camera(view).contains(p, 30.0))
        })
    };
    if !View::BOTH.into_iter().all(rim_inside) {
        return None;
    }
    let mut scenario = Scenario {
        seed,
        model: o.model,
        true_dh,
        given_dh,
        start: graspd_rt::arm::READY,
        true_rig,
        given_rig: miscalibrated(o, rng, &true_rig),
        gripper,
        base_from_left,
        base_from_object,
        grasp_turn_rad: turn,
        stage,
        sensor,
        clicks: [Pixel::zeros(); 2],
    };
    if o.with_arm {
        scenario.start = draw_start(&scenario, &body, rng)?;
    }
    for view in View::BOTH {
        scenario.clicks[view.index()] = draw_click(&scenario, &body, o.with_arm, view, rng)?;
    }
    Some(scenario)
}

fn draw_wheel(o: &Options, rng: &mut ChaCha8Rng) -> Wheel {
    let hidden = o.rim_occlusion.clamp(0.0, 0.6) * TAU;
    Wheel {
        core_radius_m: within(rng, o.core_radius_m),
        bar_radius_m: within(rng, o.bar_radius_m),
        paint_width_m: o.paint_width_m.max(0.0),
        spokes: rng.random_range(3..6),
        spoke_angle_rad: rng.random_range(0.0..TAU),
        stem_m: rng.random_range(0.06..0.09),
        hidden_rad: [rng.random_range(0.0..TAU), hidden],
    }
}

fn draw_rig(o: &Options, rng: &mut ChaCha8Rng, target: &Vec3, towards: &Vec3) -> Option<(Pose, Rig)> {
    let jitter = |rng: &mut ChaCha8Rng, r: f64| unit(rng) * rng.random_range(0.0..r);
    // The cameras point at the space in front of the valve, where the gripper will move.
    let aim = target + towards * 0.05 + jitter(rng, 0.04);
    let middle = target + towards * o.distance_m * rng.random_range(0.95..1.05);
    let up = if towards.z.abs() > 0.95 { Vec3::x() } else { Vec3::z() };
    let roll = Rotation3::from_axis_angle(&nalgebra::Unit::new_normalize(*towards), rng.random_range(-0.12..0.12));
    // Image x axis of a camera that looks along -towards with y down.
    let across = roll * (-towards).cross(&up).try_normalize(1e-3)?;
    let pose = |rng: &mut ChaCha8Rng, side: f64| {
        let centre = middle + across * (0.5 * side * o.baseline_m) + jitter(rng, 0.01);
        let look = aim + jitter(rng, 0.015) - centre;
        Pose::from_parts(Translation3::from(centre), frame(&look, &across))
    };
    let base_from_left = pose(rng, -1.0);
    let base_from_right = pose(rng, 1.0);
    let camera = |rng: &mut ChaCha8Rng| {
        let f = o.focal_px * rng.random_range(0.985..1.015);
        let [w, h] = o.size;
        Camera {
            width: w,
            height: h,
            fx: f,
            fy: f * rng.random_range(0.999..1.001),
            cx: 0.5 * (f64::from(w) - 1.0) + rng.random_range(-8.0..8.0),
            cy: 0.5 * (f64::from(h) - 1.0) + rng.random_range(-8.0..8.0),
            distortion: Distortion {
                k1: rng.random_range(-0.16..-0.05),
                k2: rng.random_range(0.02..0.10),
                p1: rng.random_range(-6e-4..6e-4),
                p2: rng.random_range(-6e-4..6e-4),
                ..Default::default()
            },
        }
        .validated()
        .ok()
    };
    let rig =
        Rig { left: camera(rng)?, right: camera(rng)?, right_from_left: base_from_right.inverse() * base_from_left };
    Some((base_from_left, rig))
}

/// The rig that graspd is given: the true one with the calibration errors of the options.
fn miscalibrated(o: &Options, rng: &mut ChaCha8Rng, truth: &Rig) -> Rig {
    let mut given = *truth;
    let k = 1.0 + sign(rng) * o.focal_error;
    for c in [&mut given.left, &mut given.right] {
        c.fx *= k;
        c.fy *= k;
    }
    let axis = unit(rng) * o.rotation_error_deg.to_radians();
    given.right_from_left.rotation = UnitQuaternion::from_scaled_axis(axis) * given.right_from_left.rotation;
    given
}

/// The true kinematics: every length and angle differs from the nominal one by the options' error, with a random sign.
fn perturbed(o: &Options, rng: &mut ChaCha8Rng) -> Dh {
    let mut delta = |size: f64| std::array::from_fn(|_| sign(rng) * size);
    let (mm, rad) = (o.kinematics_error_mm * 1e-3, o.kinematics_error_deg.to_radians());
    let error = Dh { a: delta(mm), d: delta(mm), alpha: delta(rad), theta: delta(rad) };
    o.model.dh().plus(&error)
}

fn draw_stage(
    o: &Options,
    rng: &mut ChaCha8Rng,
    wheel: Wheel,
    base_from_object: &Pose,
    towards: &Vec3,
) -> (Stage, Sensor) {
    let to_object = base_from_object.rotation.inverse();
    // Diffuse light and a lamp near the cameras, never behind the valve. Hard light from the side shades a painted bar
    // and shifts its apparent edges by more than 0.1 px towards the lamp; cells are not set up like that.
    let mut light = to_object * (towards + unit(rng) * 0.5);
    light.z = light.z.max(0.35);
    let pipe_angle_rad = rng.random_range(0.0..PI);
    let wall_m = wheel.stem_m + rng.random_range(0.12..0.3);
    let bolts_m = (0..o.clutter)
        .map(|k| {
            let (r, a) = (rng.random_range(0.12..0.45), rng.random_range(0.0..TAU));
            [r * a.cos(), r * a.sin(), rng.random_range(0.004..0.010) * if k % 3 == 2 { -1.0 } else { 1.0 }]
        })
        .collect();
    let stage = Stage {
        wheel,
        pipe_radius_m: rng.random_range(0.028..0.042),
        pipe_angle_rad,
        wall_m,
        bolts_m,
        albedo: [
            rng.random_range(0.80..0.92),
            rng.random_range(0.20..0.30),
            rng.random_range(0.20..0.32),
            rng.random_range(0.25..0.40),
            rng.random_range(0.32..0.46),
        ],
        light: light.normalize().into(),
        ambient: rng.random_range(0.60..0.72),
        diffuse: rng.random_range(0.28..0.40),
        texture: rng.random_range(0.04..0.12),
        white: rng.random_range(215.0..250.0),
    };
    let sensor = Sensor {
        blur_px: rng.random_range(0.4..0.65),
        vignetting: rng.random_range(0.08..0.22),
        read_noise: o.noise * rng.random_range(0.7..1.5),
        shot_noise: o.noise * o.noise * rng.random_range(0.008..0.02),
    };
    (stage, sensor)
}

/// Start joints from which the arm can move in straight lines to pre-grasp and grasp, with the marks visible on the
/// whole path and the rim unobstructed at the start.
fn draw_start(s: &Scenario, body: &Body, rng: &mut ChaCha8Rng) -> Option<Joints> {
    let flange_from_gripper = s.gripper.gripper.flange_from_gripper;
    let open = s.gripper.opening[1];
    let left_from_object = s.left_from_object();
    let grasp = s.object_from_grasp(0.0);
    let pregrasp = s.object_from_grasp(STANDOFF_M);
    let ends_seen = [&grasp, &pregrasp]
        .iter()
        .all(|p| seen_marks(body, &s.true_rig, &(left_from_object * **p), open, 15.0).both >= 7);
    if !ends_seen {
        return None;
    }
    for _ in 0..6 {
        let away = unit(rng);
        let away = Vec3::new(away.x, away.y, away.z.abs() + 0.5).normalize();
        let distance = rng.random_range(0.27..0.46);
        let lean = UnitQuaternion::from_scaled_axis(unit(rng) * rng.random_range(0.03..0.40));
        let start = Pose::from_parts(Translation3::from(away * distance), grasp.rotation * lean);
        if away.z * distance < STANDOFF_M || !rim_is_free(s, body, &start) {
            continue;
        }
        let mut object_poses = line(&start, &pregrasp, 16);
        object_poses.extend(line(&pregrasp, &grasp, 5).into_iter().skip(1));
        let visible = object_poses.iter().enumerate().all(|(k, p)| {
            let least = if k == 0 { body.marks.len() } else { 7 };
            seen_marks(body, &s.true_rig, &(left_from_object * p), open, 25.0).both >= least
        });
        if !visible {
            continue;
        }
        let poses: Vec<Pose> = object_poses.iter().map(|p| s.base_from_object * p).collect();
        let first = poses.first()? * flange_from_gripper.inverse();
        for q in closed_form(&s.model.dh(), &first, 0.0) {
            let q = within_half_turn(q);
            let Some(joints) = straight_path(s.model, &s.true_dh, &flange_from_gripper, &poses, &q) else { continue };
            // The plan may choose another rotation about the axis, because visibility hardly depends on it: the arm
            // must be able to follow those paths as well.
            let turned = [-0.7, -0.35, 0.35, 0.7].iter().all(|t| {
                let turn = s.grasp_turn_rad + t;
                let mut path = line(&start, &grasp_pose(turn, STANDOFF_M), 16);
                path.extend(line(&grasp_pose(turn, STANDOFF_M), &grasp_pose(turn, 0.0), 5).into_iter().skip(1));
                let path: Vec<Pose> = path.iter().map(|p| s.base_from_object * p).collect();
                joints
                    .first()
                    .is_some_and(|q| straight_path(s.model, &s.true_dh, &flange_from_gripper, &path, q).is_some())
            });
            if turned {
                return joints.first().copied();
            }
        }
    }
    None
}

/// The same arm configuration with every angle within half a turn of zero.
fn within_half_turn(q: Joints) -> Joints {
    q.map(|v| v - TAU * (v / TAU).round())
}

/// Whether gripper and wrist leave the rim unobstructed in both images.
fn rim_is_free(s: &Scenario, body: &Body, object_from_gripper: &Pose) -> bool {
    let left_from_object = s.left_from_object();
    let gripper_from_object = object_from_gripper.inverse();
    let r = s.stage.wheel.outer_radius() + 0.012;
    View::BOTH.into_iter().all(|view| {
        let centre = left_from_object.inverse() * Point3::from(s.true_rig.centre(view));
        let camera = (gripper_from_object * centre).coords;
        (0..48).all(|k| {
            let a = TAU * f64::from(k) / 48.0;
            [1.0, 0.6].iter().all(|f| {
                let p = gripper_from_object * Point3::new(f * r * a.cos(), f * r * a.sin(), 0.0);
                !body.hides(&camera, &p.coords, s.gripper.opening[1])
            })
        })
    })
}

/// A click of an operator: within two pixels of the outer edge of the painted circle (of the rim on a bare wheel),
/// where it is unobstructed.
fn draw_click(s: &Scenario, body: &Body, with_arm: bool, view: View, rng: &mut ChaCha8Rng) -> Option<Pixel> {
    let left_from_object = s.left_from_object();
    let radius = s.stage.wheel.paint_radii().map_or(s.stage.wheel.outer_radius(), |r| r[1]);
    let gripper_from_object = s.object_from_gripper(&s.start).inverse();
    let camera_object = left_from_object.inverse() * Point3::from(s.true_rig.centre(view));
    for _ in 0..200 {
        let a = rng.random_range(0.0..TAU);
        let p = Point3::new(radius * a.cos(), radius * a.sin(), 0.0);
        let [first, extent] = s.stage.wheel.hidden_rad;
        if (a - first + 0.2).rem_euclid(TAU) < extent + 0.4 && extent > 0.0 {
            continue;
        }
        let covered = with_arm
            && body.hides(
                &(gripper_from_object * camera_object).coords,
                &(gripper_from_object * p).coords,
                s.gripper.opening[1],
            );
        if covered {
            continue;
        }
        let at = s.true_rig.project(view, &(left_from_object * p).coords)?;
        let off = Pixel::new(rng.random_range(-1.2..1.2), rng.random_range(-1.2..1.2));
        return Some((at + off).map(|v| (v * 10.0).round() / 10.0));
    }
    None
}
