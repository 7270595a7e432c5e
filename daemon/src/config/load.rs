//! From the file's text to the checked configuration.

use super::check_trust;
use super::kinematics::load_kinematics;
use super::limits::load_limits;
use super::names::names;
use super::ranges::{bad, check_numbers, check_outputs, outputs_word};
use super::raw::{RawArm, RawConfig, RawLoop, RawServo};
use super::renamed::check_renamed;
use super::settings::{ArmSettings, Clock, Config, FrameSettings, Kinematics, LinkKind, LoopSettings, ReadFile};
use crate::arm::Motion;
use crate::exit::Failure;
use crate::realtime::ThreadSettings;
use graspd_calib::files::{GripperFile, RigFile};
use graspd_rt::arm::Model;
use graspd_rt::cycle::{ConvergeSettings, TaskSettings};
use graspd_rt::online::path::PathSettings;
use graspd_rt::online::screw::{JacobianAt, LawSettings, ViewMode};
use std::path::Path;

impl Config {
    /// Reads and checks a configuration and every file it names.
    ///
    /// # Errors
    /// Names the file, the key, the value and the fix.
    pub fn load(path: &Path) -> Result<Self, Failure> {
        let shown = path.display();
        check_trust(path)?;
        let text = std::fs::read_to_string(path).map_err(|e| {
            Failure::input(format!("{shown}: cannot be read ({e}); docs/CONFIG.md has an example to start from"))
        })?;
        check_renamed(path, &text)?;
        let mut raw: RawConfig = toml::from_str(&text)
            .map_err(|e| Failure::input(format!("{shown}: {e}\nSee docs/CONFIG.md for every key.")))?;
        let model = Model::from_name(&raw.arm.model).ok_or_else(|| {
            bad(path, "arm.model", &raw.arm.model, "use ur3, ur5, ur10, ur3e, ur5e, ur10e, ur16e, ur20 or ur30")
        })?;
        if raw.cycle.rate_hz == 0.0 {
            raw.cycle.rate_hz = controller_hz(model);
        }
        check_numbers(path, &raw)?;
        check_outputs(path, &raw)?;
        let threads = loop_settings(path, &raw.cycle, model)?;
        let folder = path.parent().unwrap_or(Path::new("."));
        let names = names(&raw.cell, raw.shm.root.as_deref().map(|r| folder.join(r)).as_deref())
            .map_err(|e| Failure::input(format!("{shown}: {e}")))?;
        let (rig_path, gripper_path) = (folder.join(&raw.files.rig), folder.join(&raw.files.gripper));
        for file in [&rig_path, &gripper_path] {
            check_trust(file)?;
        }
        let rig = RigFile::load(&rig_path).map_err(|e| Failure::input(e.to_string()))?;
        let gripper = GripperFile::load(&gripper_path).map_err(|e| Failure::input(e.to_string()))?;
        let arm = arm_settings(path, &raw.arm, model)?;
        let law = law_settings(path, &raw.servo, raw.vision.min_observations)?;
        let (limits, stop) = load_limits(path, &raw.limits, model, threads.period_ns())?;
        let mut files = vec![path.to_owned(), rig_path.clone(), gripper_path.clone()];
        if let Kinematics::File(file, _) = &arm.kinematics {
            files.push(file.clone());
        }
        Ok(Self {
            names,
            rig,
            rig_path,
            gripper,
            gripper_path,
            arm,
            threads,
            frames: FrameSettings {
                poll_ns: (raw.vision.poll_us * 1000.0) as u64,
                period_ns: (1e9 / raw.vision.frame_rate_hz) as u64,
                max_skew_ns: (raw.vision.max_skew_ms * 1e6) as u64,
            },
            law,
            path: PathSettings {
                speed_m_per_s: raw.servo.path_speed_m_s,
                turn_rad_per_s: raw.servo.path_speed_rad_s,
                ..PathSettings::default()
            },
            converge: converge_settings(&raw),
            task: task_settings(&raw),
            limits,
            stop,
            files: files.into_iter().map(ReadFile::read).collect(),
        })
    }
}

/// The value that a name stands for.
fn choice<T: Copy>(path: &Path, key: &str, value: &str, choices: &[(&str, T)]) -> Result<T, Failure> {
    choices.iter().find(|(name, _)| *name == value).map(|(_, choice)| *choice).ok_or_else(|| {
        let names: Vec<&str> = choices.iter().map(|(name, _)| *name).collect();
        bad(path, key, value, &format!("use one of: {}", names.join(", ")))
    })
}

/// Steps a second of the controller of this model.
fn controller_hz(model: Model) -> f64 {
    if model.is_e_series() { 500.0 } else { 125.0 }
}

fn loop_settings(path: &Path, raw: &RawLoop, model: Model) -> Result<LoopSettings, Failure> {
    let clock = choice(path, "loop.clock", &raw.clock, &[("timer", Clock::Timer), ("robot", Clock::Robot)])?;
    if clock == Clock::Robot && raw.rate_hz != controller_hz(model) {
        return Err(bad(
            path,
            "loop.rate_hz",
            &raw.rate_hz.to_string(),
            &format!(
                "loop.clock = \"robot\" runs at the controller's rate: remove loop.rate_hz, or set it to {}",
                controller_hz(model)
            ),
        ));
    }
    Ok(LoopSettings {
        rate_hz: raw.rate_hz,
        clock,
        command: ThreadSettings { priority: raw.command_priority, core: raw.command_core },
        vision: ThreadSettings { priority: raw.vision_priority, core: raw.vision_core },
        spin_ns: (raw.spin_us * 1000.0) as u64,
        require_realtime: raw.require_realtime,
        best_effort: raw.best_effort,
    })
}

fn arm_settings(path: &Path, raw: &RawArm, model: Model) -> Result<ArmSettings, Failure> {
    let link = choice(path, "arm.link", &raw.link, &[("rtde", LinkKind::Rtde), ("mock", LinkKind::Mock)])?;
    let kinematics = match raw.kinematics.as_str() {
        "controller" => Kinematics::Controller,
        "nominal" => Kinematics::Nominal,
        file => {
            let file = path.parent().unwrap_or(Path::new(".")).join(file);
            check_trust(&file)?;
            let dh = Box::new(load_kinematics(&file, model)?);
            Kinematics::File(file, dh)
        }
    };
    let motion =
        choice(path, "arm.motion", &raw.motion, &[("velocity", Motion::Velocity), ("position", Motion::Position)])?;
    Ok(ArmSettings {
        link,
        address: raw.address.clone(),
        port_offset: raw.port_offset,
        model,
        kinematics,
        motion,
        watchdog_ms: raw.watchdog_ms,
    })
}

fn law_settings(path: &Path, raw: &RawServo, min_observations: usize) -> Result<LawSettings, Failure> {
    let views =
        [("stereo", ViewMode::Stereo), ("left", ViewMode::Left), ("right", ViewMode::Right), ("best", ViewMode::Best)];
    let jacobians = [("current", JacobianAt::Current), ("desired", JacobianAt::SetPoint), ("mean", JacobianAt::Mean)];
    let views = choice(path, "servo.views", &raw.views, &views)?;
    // One view gives half of the observations.
    let needed = if views == ViewMode::Stereo { min_observations } else { min_observations.div_ceil(2) };
    Ok(LawSettings {
        views,
        jacobian: choice(path, "servo.jacobian", &raw.jacobian, &jacobians)?,
        gain_far_per_s: raw.gain,
        gain_near_per_s: raw.gain_near,
        min_points: u8::try_from(needed).unwrap_or(u8::MAX),
        ..LawSettings::default()
    })
}

fn converge_settings(raw: &RawConfig) -> ConvergeSettings {
    ConvergeSettings {
        position_m: raw.converged.distance_m,
        angle_rad: raw.converged.angle_rad,
        error_px: raw.converged.error_px,
        frames: raw.converged.frames,
        ..ConvergeSettings::default()
    }
}

fn task_settings(raw: &RawConfig) -> TaskSettings {
    let g = &raw.gripper;
    TaskSettings {
        close_outputs: outputs_word(&g.close_set, &g.close_clear),
        open_outputs: outputs_word(&g.open_set, &g.open_clear),
        grip_ns: (g.time_ms * 1e6) as u64,
        close_on_arrival: g.close_on_arrival,
        ..TaskSettings::default()
    }
}
