//! Invalid input: one error that names file, key and fix, the documented exit code, and no output file.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a failure must panic

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn example(name: &str) -> String {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/motorcycle").join(name).display().to_string()
}

/// A new folder for one test.
fn folder(name: &str) -> PathBuf {
    let dir = std::env::temp_dir().join(format!("graspd-test-{}-{name}", std::process::id()));
    let _ = std::fs::remove_dir_all(&dir);
    std::fs::create_dir_all(&dir).unwrap();
    dir
}

fn graspd(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_graspd")).args(args).output().unwrap()
}

/// Runs graspd and expects this exit code and an error that contains every part.
fn refused(args: &[&str], code: i32, parts: &[&str]) {
    let out = graspd(args);
    let error = String::from_utf8_lossy(&out.stderr).into_owned();
    assert_eq!(out.status.code(), Some(code), "graspd {args:?}: {error}");
    for part in parts {
        assert!(error.contains(part), "the error of graspd {args:?} does not contain {part:?}: {error}");
    }
    assert!(!error.contains("panicked"), "{error}");
}

struct Plan {
    left: String,
    right: String,
    rig: String,
    gripper: String,
    select: [String; 2],
    out: PathBuf,
}

impl Plan {
    fn good(dir: &Path) -> Self {
        Self {
            left: example("left.png"),
            right: example("right.png"),
            rig: example("rig.toml"),
            gripper: example("gripper.toml"),
            select: ["653.0,407.4".into(), "602.0,407.0".into()],
            out: dir.join("plan.toml"),
        }
    }

    fn args(&self) -> Vec<String> {
        let out = self.out.display().to_string();
        ["plan", "--left", &self.left, "--right", &self.right, "--rig", &self.rig, "--gripper", &self.gripper]
            .into_iter()
            .chain(["--select-left", &self.select[0], "--select-right", &self.select[1], "--out", &out])
            .map(str::to_owned)
            .collect()
    }

    fn refused(&self, code: i32, parts: &[&str]) {
        let args = self.args();
        refused(&args.iter().map(String::as_str).collect::<Vec<_>>(), code, parts);
        assert!(!self.out.exists(), "a refused plan must not leave a file");
    }
}

#[test]
fn a_missing_image_names_the_file() {
    let dir = folder("missing");
    let mut p = Plan::good(&dir);
    p.left = dir.join("nowhere.png").display().to_string();
    p.refused(3, &["nowhere.png"]);
}

#[test]
fn a_file_that_is_not_an_image_is_named() {
    let dir = folder("notimage");
    let mut p = Plan::good(&dir);
    let file = dir.join("left.png");
    std::fs::write(&file, b"this is not an image").unwrap();
    p.left = file.display().to_string();
    p.refused(3, &["left.png"]);
}

#[test]
fn an_image_size_mismatch_names_both_sizes() {
    let dir = folder("size");
    let mut p = Plan::good(&dir);
    let file = dir.join("small.png");
    image::GrayImage::new(320, 200).save(&file).unwrap();
    p.right = file.display().to_string();
    p.refused(3, &["320", "200", "741", "500"]);
}

#[test]
fn invalid_toml_and_unknown_keys_are_reported_with_file_and_key() {
    let dir = folder("toml");
    let mut p = Plan::good(&dir);
    let rig = std::fs::read_to_string(example("rig.toml")).unwrap();
    let bad = dir.join("rig.toml");
    p.rig = bad.display().to_string();
    std::fs::write(&bad, format!("{rig}\n[left\n")).unwrap();
    p.refused(3, &["rig.toml"]);
    std::fs::write(&bad, rig.replace("fx", "focal_lenght")).unwrap();
    p.refused(3, &["rig.toml", "focal_lenght"]);
}

#[test]
fn swapped_views_are_detected() {
    let dir = folder("swapped");
    let mut p = Plan::good(&dir);
    std::mem::swap(&mut p.left, &mut p.right);
    p.select.swap(0, 1);
    p.refused(3, &["swap"]);
}

#[test]
fn a_click_outside_the_image_is_refused() {
    let dir = folder("far");
    let mut p = Plan::good(&dir);
    p.select[0] = "-400,-300".into();
    let args = p.args();
    let out = graspd(&args.iter().map(String::as_str).collect::<Vec<_>>());
    assert!(matches!(out.status.code(), Some(2 | 3)), "{}", String::from_utf8_lossy(&out.stderr));
    assert!(!p.out.exists());
    p.select[0] = "not,numbers".into();
    p.refused(2, &["not,numbers"]);
}

#[test]
fn a_configuration_error_names_file_key_and_value() {
    let dir = folder("config");
    let config = dir.join("graspd.toml");
    let shown = config.display().to_string();
    refused(&["run", "--config", &shown], 3, &["graspd.toml", "cannot be read"]);
    let files = format!("[files]\nrig = \"{}\"\ngripper = \"{}\"\n", example("rig.toml"), example("gripper.toml"));
    let write = |text: &str| std::fs::write(&config, text).unwrap();
    write(&format!("{files}[arm]\nmodel = \"ur5e\"\nadress = \"x\"\n"));
    refused(&["run", "--config", &shown], 3, &["graspd.toml", "adress"]);
    write(&format!("{files}[arm]\nmodel = \"ur99\"\n"));
    refused(&["run", "--config", &shown], 3, &["arm.model", "ur99", "ur5e"]);
    write(&format!("{files}[arm]\nmodel = \"ur5e\"\n[loop]\nrate_hz = 5000.0\n"));
    refused(&["check", "--config", &shown], 3, &["loop.rate_hz", "5000", "1000"]);
    write(&format!("{files}[arm]\nmodel = \"ur5e\"\n[loop]\ncommand_priority = 40\nvision_priority = 60\n"));
    refused(&["check", "--config", &shown], 3, &["loop.vision_priority"]);
    write(&format!("{files}[arm]\nmodel = \"ur5e\"\n[limits]\ntcp_speed_m_s = nan\n"));
    refused(&["check", "--config", &shown], 3, &["limits.tcp_speed_m_s"]);
    for (old, new) in
        [("[loop]\nbeat = \"robot\"", "loop.clock"), ("[limits]\njoint_speed_rad_s = 3.0", "limits.joint_speed_rad_s")]
    {
        write(&format!("{files}[arm]\nmodel = \"ur5e\"\n{old}\n"));
        for verb in ["check", "run"] {
            refused(&[verb, "--config", &shown], 3, &["graspd.toml", new]);
        }
    }
    write(&format!("{files}[arm]\nmodel = \"ur5e\"\n"));
    let out = graspd(&["check", "--config", &shown]);
    assert_eq!(out.status.code(), Some(0), "{}", String::from_utf8_lossy(&out.stderr));
}

#[test]
fn verbs_without_a_daemon_exit_with_the_link_code() {
    let dir = folder("nodaemon");
    let root = dir.join("shm").display().to_string();
    for verb in ["status", "arm", "servo", "stop", "reset", "recover"] {
        refused(&[verb, "--cell", "nobody", "--shm-root", &root, "--timeout", "0.2"], 4, &["no daemon"]);
    }
    refused(&["setpoint", "nowhere.toml", "--cell", "nobody", "--shm-root", &root], 3, &["nowhere.toml"]);
    refused(&["status", "--timeout=-1"], 2, &["--timeout"]);
    refused(&["dance"], 2, &["dance"]);
}

#[test]
fn help_and_version_are_not_errors() {
    for args in [vec!["--help"], vec!["plan", "--help"], vec!["--version"]] {
        assert_eq!(graspd(&args).status.code(), Some(0), "{args:?}");
    }
}
