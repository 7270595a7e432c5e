//! A part with a mesh, from files to a plan: a consistent pose from picked pixels, all handles, reproducible bytes.
#![allow(clippy::unwrap_used, clippy::field_reassign_with_default)] // a test, bench or example

use graspd_calib::commands::mesh::{MeshRequest, run};
use graspd_calib::commands::{Class, Outcome};
use graspd_calib::files::{GripperFile, PlanFile, RigFile};
use graspd_rt::geom::{Pose, Vec3, View};
use nalgebra::{Matrix3, Point3, UnitQuaternion};
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, Normal};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

const RIG: &str = r#"
schema = "graspd-rig/1"
[left]
width = 1280
height = 1024
fx = 1200.0
fy = 1200.0
cx = 640.0
cy = 512.0
distortion = { k1 = -0.1, k2 = 0.02 }
[right]
width = 1280
height = 1024
fx = 1190.0
fy = 1190.0
cx = 630.0
cy = 520.0
[right_from_left]
translation_m = [-0.48, 0.0, 0.08]
rotation_vector_rad = [0.0, 0.32, 0.0]
"#;

/// A temporary folder for each test, removed at its end.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("graspd-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        let f = Self(path);
        f.write("rig.toml", RIG);
        f.write("gripper.toml", gripper(0.08));
        f
    }

    fn write(&self, name: &str, content: impl AsRef<[u8]>) -> PathBuf {
        let path = self.0.join(name);
        std::fs::write(&path, content).unwrap();
        path
    }

    fn request(&self, mesh: &Path) -> MeshRequest {
        MeshRequest {
            mesh: mesh.to_owned(),
            unit: "mm".to_owned(),
            rig: self.0.join("rig.toml"),
            gripper: self.0.join("gripper.toml"),
            ..Default::default()
        }
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn gripper(max: f64) -> String {
    let mark = |x: f64, y: f64, z: f64| {
        format!(
            "[[mark]]\nposition_m = [{x}, {y}, {z}]\nnormal = [0.0, -0.7, -0.7]\ndiameter_m = 0.012\npolarity = \"dark\"\n"
        )
    };
    let mut out = format!(
        "schema = \"graspd-gripper/1\"\nopening_m = [0.0, {max}]\nfinger_length_m = 0.05\n\
         flange_from_gripper = {{ translation_m = [0.0, 0.0, 0.18], quaternion_wxyz = [1.0, 0.0, 0.0, 0.0] }}\n"
    );
    for (x, y, z) in [
        (-0.04, -0.03, -0.09),
        (0.04, -0.03, -0.09),
        (0.04, -0.015, -0.11),
        (-0.03, -0.015, -0.11),
        (0.0, -0.022, -0.1),
    ] {
        out += &mark(x, y, z);
    }
    for side in ["+x", "-x"] {
        let s = if side == "+x" { 1.0 } else { -1.0 };
        let _ = writeln!(
            out,
            "[[finger]]\nside = \"{side}\"\ncentre_m = [{}, 0.0, -0.02]\nhalf_size_m = [0.004, 0.008, 0.03]",
            0.004 * s
        );
    }
    out + "[[body]]\ncentre_m = [0.0, 0.0, -0.075]\nhalf_size_m = [0.05, 0.025, 0.022]\n"
}

type Corners = Vec<[[f64; 3]; 3]>;

fn block(lo: [f64; 3], hi: [f64; 3]) -> Corners {
    let p = |i: usize| [0, 1, 2].map(|k| if i >> k & 1 == 1 { hi[k] } else { lo[k] });
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    quads.iter().flat_map(|q| [[p(q[0]), p(q[1]), p(q[2])], [p(q[0]), p(q[2]), p(q[3])]]).collect()
}

fn stl(t: &Corners) -> Vec<u8> {
    let mut out = vec![0u8; 80];
    out.extend((t.len() as u32).to_le_bytes());
    for c in t {
        out.extend([0u8; 12]);
        out.extend(c.iter().flatten().flat_map(|v| (*v as f32).to_le_bytes()));
        out.extend([0u8; 2]);
    }
    out
}

/// A stepped block: a foot with a ridge, millimetres.
fn stepped() -> Corners {
    let mut t = block([-50.0, -20.0, 0.0], [50.0, 20.0, 10.0]);
    t.extend(block([-10.0, -20.0, 10.0], [10.0, 20.0, 40.0]));
    t
}

fn truth() -> Pose {
    Pose::from_parts(Vec3::new(0.02, 0.05, 1.3).into(), UnitQuaternion::from_scaled_axis(Vec3::new(2.2, 0.4, 0.3)))
}

/// Corners of the stepped block as an operator would pick them, with noise.
fn picks(sigma: f64, seed: u64) -> Vec<String> {
    let rig = RigFile::parse(RIG, "rig").unwrap().rig;
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let noise = Normal::new(0.0, sigma).unwrap();
    [
        [-50.0, -20.0, 10.0],
        [50.0, -20.0, 10.0],
        [50.0, 20.0, 10.0],
        [-50.0, 20.0, 10.0],
        [-10.0, -20.0, 40.0],
        [10.0, 20.0, 40.0],
        [10.0, -20.0, 40.0],
        [-50.0, -20.0, 0.0],
    ]
    .map(|p: [f64; 3]| {
        let x = (truth() * Point3::from(Vec3::from(p) * 1e-3)).coords;
        let mut px = |v| {
            let q = rig.project(v, &x).unwrap();
            (q.x + noise.sample(&mut rng), q.y + noise.sample(&mut rng))
        };
        let ((a, b), (c, d)) = (px(View::Left), px(View::Right));
        format!("{},{},{}={a},{b},{c},{d}", p[0], p[1], p[2])
    })
    .to_vec()
}

fn done(o: &Outcome) -> &Outcome {
    assert_eq!(o.class, Class::Done, "{}", o.text);
    o
}

#[test]
fn picked_pixels_give_a_pose_with_a_consistent_covariance() {
    let f = Folder::new("picks");
    let mesh = f.write("part.stl", stl(&stepped()));
    let out = f.0.join("plan.toml");
    let (mut squared, mut turns, n) = (0.0, 0.0, 60);
    for seed in 0..n {
        let request = MeshRequest {
            picks: picks(1.0, seed),
            out: Some(out.clone()),
            tolerance_mm: Some(10.0),
            tolerance_deg: Some(5.0),
            pick_limit_px: Some(8.0),
            ..f.request(&mesh)
        };
        done(&run(&request));
        let text = std::fs::read_to_string(&out).unwrap();
        let plan = PlanFile::parse(&text, "plan").unwrap();
        // The grasp error: the motion between the true part and the estimated one.
        let record = plan.mesh.as_ref().unwrap().left_from_mesh.clone();
        let pose = |p: &graspd_calib::files::PoseRecord| {
            let [w, i, j, k] = p.quaternion_wxyz.unwrap();
            Pose::from_parts(
                Vec3::from(p.translation_m).into(),
                UnitQuaternion::new_normalize(nalgebra::Quaternion::new(w, i, j, k)),
            )
        };
        let error = truth() * pose(&record).inverse();
        let centre = Vec3::from(plan.object.centre_m);
        let e = (error * Point3::from(centre)).coords - centre;
        let cov = Matrix3::from_fn(|i, j| plan.object.covariance_centre_m2[i][j]);
        squared += e.dot(&(cov.try_inverse().unwrap() * e));
        let normal = Vec3::from(plan.object.normal);
        let frame = pose(&plan.object.left_from_object);
        let d = frame.rotation.inverse() * (error.rotation * normal);
        let c = plan.object.covariance_normal_rad2;
        let cov = nalgebra::Matrix2::new(c[0][0], c[0][1], c[1][0], c[1][1]);
        let d = nalgebra::Vector2::new(d.x, d.y);
        turns += d.dot(&(cov.try_inverse().unwrap() * d));
        assert!(plan.object.sigma_centre_mm < 3.0);
    }
    // A consistent covariance gives 3 and 2; over 60 trials the means have standard deviations of 0.3 and 0.26.
    let (d3, d2) = (squared / n as f64, turns / n as f64);
    println!("mean squared Mahalanobis distance: position {d3:.2} of 3, axis {d2:.2} of 2");
    assert!((2.0..4.2).contains(&d3) && (1.2..3.0).contains(&d2), "{d3} {d2}");
}

#[test]
fn one_wrong_pick_is_named_and_too_few_are_refused() {
    let f = Folder::new("wrong");
    let mesh = f.write("part.stl", stl(&stepped()));
    for wrong in 0..8 {
        let mut p = picks(0.3, 5);
        let (point, pixels) = p[wrong].split_once('=').unwrap();
        let mut px: Vec<f64> = pixels.split(',').map(|v| v.parse().unwrap()).collect();
        px[wrong % 4] += 35.0;
        p[wrong] = format!("{point}={},{},{},{}", px[0], px[1], px[2], px[3]);
        let o = run(&MeshRequest { picks: p, ..f.request(&mesh) });
        assert_eq!(o.class, Class::Input);
        assert!(o.text.contains(&format!("picked point {}", wrong + 1)), "{wrong}: {}", o.text);
    }
    let o = run(&MeshRequest { picks: picks(0.3, 5)[..2].to_vec(), ..f.request(&mesh) });
    assert!(o.class == Class::Input && o.text.contains("at least 3"), "{}", o.text);
    let o = run(&MeshRequest { picks: vec!["1,2,3=4,5,6".to_owned()], ..f.request(&mesh) });
    assert!(o.class == Class::Usage && o.text.contains("--pick-mesh"), "{}", o.text);
    assert_eq!(run(&f.request(&mesh)).class, Class::Usage);
}

#[test]
fn the_report_is_one_complete_page() {
    let f = Folder::new("report");
    let mesh = f.write("part.stl", stl(&stepped()));
    let page = |name: &str, r: MeshRequest| {
        let path = f.0.join(name);
        let o = run(&MeshRequest { report: Some(path.clone()), ..r });
        done(&o);
        (std::fs::read_to_string(&path).unwrap(), o)
    };
    let picked = MeshRequest { picks: picks(0.5, 2), ..f.request(&mesh) };
    let (html, o) = page("a.html", picked.clone());
    assert!(html == page("b.html", picked).0, "the same input gave a different page");
    // No external resources; the image, the residuals of both views and both uncertainty ellipses are in the page.
    assert!(!html.contains("http") && !html.contains("<script") && html.contains("data:image/png;base64,"));
    assert_eq!(html.matches("<svg").count(), 4);
    assert!(html.contains(o.json["set_point"].as_str().unwrap()));
    // A row for each pick and each handle, in the order of the list, every reason in full.
    let rows = o.json["handles"].as_array().unwrap();
    let table = html.split("<h2>Handles").nth(1).unwrap();
    assert_eq!(table.matches("<tr><td>").count(), rows.len());
    assert_eq!(
        html.split("<h2>Uncertainty").next().unwrap().split("<h2>Picked").nth(1).unwrap().matches("<tr><td>").count(),
        8
    );
    let mut from = 0;
    for r in rows {
        let verdict = r["reason"].as_str().map_or(String::from("possible"), |t| format!("dropped: {t}"));
        let verdict = if r["number"] == 1 { String::from("chosen") } else { verdict };
        from += table[from..].find(&verdict).unwrap_or_else(|| panic!("{verdict}"));
    }
    // A pose from a file has no picks.
    let (html, _) = page("c.html", posed(&f, &mesh));
    assert!(!html.contains("<h2>Picked") && html.matches("<svg").count() == 2);
}

fn posed(f: &Folder, mesh: &Path) -> MeshRequest {
    let v = truth().rotation.scaled_axis();
    let t = truth().translation.vector;
    let text = format!(
        "schema = \"graspd-pose/1\"\nsigma_mm = 0.4\nsigma_deg = 0.2\n[left_from_mesh]\ntranslation_m = [{}, {}, {}]\nrotation_vector_rad = [{}, {}, {}]\n",
        t.x, t.y, t.z, v.x, v.y, v.z
    );
    MeshRequest { mesh_pose: Some(f.write("pose.toml", text)), ..f.request(mesh) }
}

#[test]
fn the_plan_is_complete_valid_for_the_loop_and_reproducible() {
    let f = Folder::new("bytes");
    let mesh = f.write("part.stl", stl(&stepped()));
    let mut texts = Vec::new();
    for k in 0..2 {
        let (out, overlay) = (f.0.join(format!("plan{k}.toml")), f.0.join(format!("plan{k}.png")));
        let o = run(&MeshRequest {
            present: Some("0.1,0.0,1.0,0,0.2,0".to_owned()),
            out: Some(out.clone()),
            overlay: Some(overlay.clone()),
            ..posed(&f, &mesh)
        });
        done(&o);
        texts.push((std::fs::read(&out).unwrap(), std::fs::read(&overlay).unwrap(), o.json.to_string()));
        let (rig, gripper) = (f.0.join("rig.toml"), f.0.join("gripper.toml"));
        let (plan, set) = PlanFile::load_for(
            &out,
            (&rig, &RigFile::load(&rig).unwrap()),
            (&gripper, &GripperFile::load(&gripper).unwrap()),
        )
        .unwrap();
        assert_eq!(format!("{:016x}", set.id), o.json["set_point"].as_str().unwrap());
        assert_eq!(plan.handle, "box");
        let back = set.grasp.left_from_gripper.inverse() * set.pregrasp.left_from_gripper;
        assert!((back.translation.vector - Vec3::new(0.0, 0.0, -0.08)).norm() < 1e-12 && back.rotation.angle() < 1e-9);
        assert!(set.grasp.marks.iter().any(|m| m.iter().flatten().count() >= 4));
        let path = plan.path.unwrap();
        assert!(path.turn_deg > 0.0 && path.length_m > 0.08);
        // Some candidates are dropped, each with its reason.
        assert!(plan.candidate.iter().any(|c| c.verdict.starts_with("dropped: ")));
        assert_eq!(plan.candidate[0].verdict, "chosen");
    }
    assert!(texts[0] == texts[1], "the same input gave different bytes");
    assert!(texts[0].1.len() > 10_000);
    // Another handle gives another plan; a dropped one is refused with its reason.
    let list = run(&MeshRequest { list: true, ..posed(&f, &mesh) });
    let rows = done(&list).json["handles"].as_array().unwrap().clone();
    assert!(list.text.contains("dropped: "));
    let first_dropped = rows.iter().position(|r| r["possible"] == false).unwrap();
    assert!(
        rows[..first_dropped].iter().all(|r| r["possible"] == true)
            && rows[first_dropped..].iter().all(|r| r["possible"] == false)
    );
    assert!(rows[first_dropped..].iter().all(|r| r["reason"].as_str().is_some_and(|s| s.len() > 10)));
    let second = run(&MeshRequest { handle: Some(2), ..posed(&f, &mesh) });
    assert_ne!(done(&second).json["set_point"], run(&posed(&f, &mesh)).json["set_point"]);
    let dropped = run(&MeshRequest { handle: Some(first_dropped + 1), ..posed(&f, &mesh) });
    assert!(dropped.class == Class::Refused && dropped.text.contains("cannot be taken"), "{}", dropped.text);
    assert_eq!(run(&MeshRequest { handle: Some(999), ..posed(&f, &mesh) }).class, Class::Usage);
}

#[test]
fn every_filter_reports_its_kind() {
    let f = Folder::new("filters");
    let mesh = f.write("part.stl", stl(&block([-20.0; 3], [20.0; 3])));
    let kinds = |r: &MeshRequest| -> Vec<String> {
        let o = run(&MeshRequest { list: true, ..r.clone() });
        let rows = done(&o).json["handles"].as_array().unwrap().clone();
        assert_eq!(rows.len(), 12, "three pairs of faces, four approaches");
        rows.iter().filter_map(|r| r["kind"].as_str().map(str::to_owned)).collect()
    };
    let plain = posed(&f, &mesh);
    // The marks are visible in front of the part, and occluded behind it.
    let hidden = kinds(&plain);
    assert!(
        !hidden.is_empty() && hidden.len() < 12 && hidden.iter().all(|k| k == "with too few marks seen"),
        "{hidden:?}"
    );
    f.write("gripper.toml", gripper(0.03));
    assert!(kinds(&plain).iter().all(|k| k == "too wide"));
    let o = run(&plain);
    assert!(
        o.class == Class::Refused
            && o.text.contains("12 too wide")
            && o.json["handles"].as_array().unwrap().len() == 12
    );
    f.write("gripper.toml", gripper(0.08));
    let far = MeshRequest { arm: Some("ur5e".to_owned()), base: Some("0,0,5,0,0,0".to_owned()), ..plain.clone() };
    assert!(kinds(&far).iter().all(|k| k == "out of reach"));
    let near = MeshRequest { base: Some("0.1,0.5,1.6,1.57,0,0".to_owned()), ..far.clone() };
    assert!(kinds(&near).len() < 12, "an arm next to the part reaches some of the handles");
    let turn = MeshRequest { present: Some("0,0,1,0,0,0".to_owned()), max_turn_deg: Some(1.0), ..plain.clone() };
    assert!(kinds(&turn).iter().any(|k| k == "with too large a turn"));
    let contact = MeshRequest { contact_mm2: Some(5000.0), ..plain.clone() };
    assert_eq!(run(&contact).class, Class::Refused);
    let uncertain = run(&MeshRequest { tolerance_mm: Some(0.1), ..plain });
    assert!(uncertain.class == Class::Refused && uncertain.json["kind"] == "too-uncertain", "{}", uncertain.text);
}

/// A scan of boxes: more than 100,000 triangles, with noise of a few hundredths of a millimetre on each corner.
fn scan(boxes: &[([f64; 3], [f64; 3])], n: usize, noise: f64) -> Corners {
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(17);
    let mut moved = std::collections::HashMap::new();
    let mut out = Vec::new();
    for (lo, hi) in boxes {
        for face in 0..6 {
            let (axis, up) = (face / 2, face % 2 == 1);
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            let mut at = |i: usize, j: usize| {
                let mut p = [0.0; 3];
                p[axis] = if up { hi[axis] } else { lo[axis] };
                p[u] = lo[u] + (hi[u] - lo[u]) * i as f64 / n as f64;
                p[v] = lo[v] + (hi[v] - lo[v]) * j as f64 / n as f64;
                let key = p.map(|x| (x * 1e4).round() as i64);
                let d = *moved.entry(key).or_insert_with(|| [0; 3].map(|_| rng.random_range(-noise..noise)));
                [0, 1, 2].map(|k| p[k] + d[k])
            };
            for i in 0..n {
                for j in 0..n {
                    let q = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
                    for t in [[q[0], q[1], q[2]], [q[0], q[2], q[3]]] {
                        out.push(if up { t } else { [t[0], t[2], t[1]] });
                    }
                }
            }
        }
    }
    out
}

#[test]
fn a_scan_has_the_handles_of_its_part() {
    let f = Folder::new("scan");
    for (name, boxes, exact) in [
        ("cube", vec![([-20.0; 3], [20.0; 3])], block([-20.0; 3], [20.0; 3])),
        (
            "stepped",
            vec![([-50.0, -20.0, 0.0], [50.0, 20.0, 10.0]), ([-10.0, -20.0, 10.0], [10.0, 20.0, 40.0])],
            stepped(),
        ),
    ] {
        let n = if boxes.len() == 1 { 132 } else { 94 };
        let corners = scan(&boxes, n, 0.015);
        assert!(corners.len() > 100_000, "{}", corners.len());
        let scanned = f.write(&format!("{name}-scan.stl"), stl(&corners));
        let cad = f.write(&format!("{name}.stl"), stl(&exact));
        let from = std::time::Instant::now();
        let s = run(&MeshRequest { list: true, ..posed(&f, &scanned) });
        println!("{name}: {} triangles in {:.2} s", corners.len(), from.elapsed().as_secs_f64());
        let c = run(&MeshRequest { list: true, ..posed(&f, &cad) });
        // Every possible handle of the CAD model is found in its scan, with the same closing line, approach and width.
        let rows = |o: &Outcome| done(o).json["handles"].as_array().unwrap().clone();
        let v = |r: &serde_json::Value, k: &str| Vec3::from_fn(|i, _| r[k][i].as_f64().unwrap());
        for want in rows(&c).iter().filter(|r| r["possible"] == true) {
            let found = rows(&s).iter().any(|r| {
                r["possible"] == true
                    && v(r, "closing").dot(&v(want, "closing")).abs() > 0.999
                    && v(r, "approach").dot(&v(want, "approach")) > 0.99
                    && (r["width_m"].as_f64().unwrap() - want["width_m"].as_f64().unwrap()).abs() < 1e-4
            });
            assert!(found, "{name}: {want}");
        }
        // The scan has no other handle.
        for got in rows(&s).iter().filter(|r| r["possible"] == true) {
            let known = rows(&c).iter().any(|r| {
                r["possible"] == true
                    && v(r, "closing").dot(&v(got, "closing")).abs() > 0.999
                    && v(r, "approach").dot(&v(got, "approach")) > 0.99
                    && (r["width_m"].as_f64().unwrap() - got["width_m"].as_f64().unwrap()).abs() < 1e-4
            });
            assert!(known, "{name}: {got}");
        }
    }
}
