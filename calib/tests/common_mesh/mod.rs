//! Parts for the tests of polyhedral handles: built from boxes, so that the solid is known without the mesh, and
//! written as files.
#![allow(dead_code, clippy::unwrap_used)] // shared by test programs, each of which uses some of it

use graspd_calib::commands::Class;
use graspd_calib::commands::mesh::{MeshRequest, run};
use graspd_rt::geom::{Pose, Vec3};
use nalgebra::{Point3, Quaternion, UnitQuaternion};
use rand::SeedableRng;
use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};

pub(crate) const RIG: &str = "schema = \"graspd-rig/1\"\n\
[left]\nwidth = 1280\nheight = 1024\nfx = 1200.0\nfy = 1200.0\ncx = 640.0\ncy = 512.0\n\
[right]\nwidth = 1280\nheight = 1024\nfx = 1190.0\nfy = 1190.0\ncx = 630.0\ncy = 520.0\n\
[right_from_left]\ntranslation_m = [-0.48, 0.0, 0.08]\nrotation_vector_rad = [0.0, 0.32, 0.0]\n";

/// A gripper, millimetres: largest opening, half width, thickness and length of a finger. The tips are at the gripper's
/// origin.
#[derive(Clone, Copy)]
pub(crate) struct Jaw {
    pub(crate) max: f64,
    pub(crate) half: f64,
    pub(crate) thick: f64,
    pub(crate) length: f64,
    /// Lower and upper corner of the body, millimetres, in the gripper frame.
    pub(crate) body: [[f64; 3]; 2],
}

pub(crate) const JAW: Jaw =
    Jaw { max: 60.0, half: 6.0, thick: 8.0, length: 40.0, body: [[-45.0, -20.0, -80.0], [45.0, 20.0, -40.0]] };

impl Jaw {
    pub(crate) fn toml(&self) -> String {
        let m = |v: f64| v * 1e-3;
        let mut out = format!(
            "schema = \"graspd-gripper/1\"\nopening_m = [0.001, {}]\nfinger_length_m = {}\n\
             flange_from_gripper = {{ translation_m = [0.0, 0.0, 0.18], quaternion_wxyz = [1.0, 0.0, 0.0, 0.0] }}\n",
            m(self.max),
            m(self.length)
        );
        for (x, y) in [(-0.04, -0.03), (0.04, -0.03), (0.04, 0.03), (-0.03, 0.03), (0.0, -0.022)] {
            out += &format!(
                "[[mark]]\nposition_m = [{x}, {y}, -0.2]\nnormal = [0.0, 0.0, -1.0]\ndiameter_m = 0.01\npolarity = \"dark\"\n"
            );
        }
        for (side, s) in [("+x", 1.0), ("-x", -1.0)] {
            out += &format!(
                "[[finger]]\nside = \"{side}\"\ncentre_m = [{}, 0.0, {}]\nhalf_size_m = [{}, {}, {}]\n",
                0.5 * m(self.thick) * s,
                -0.5 * m(self.length),
                0.5 * m(self.thick),
                m(self.half),
                0.5 * m(self.length)
            );
        }
        let [lo, hi] = self.body;
        let (c, h) = ([0, 1, 2].map(|k| m(0.5 * (lo[k] + hi[k]))), [0, 1, 2].map(|k| m(0.5 * (hi[k] - lo[k]))));
        out + &format!("[[body]]\ncentre_m = {c:?}\nhalf_size_m = {h:?}\n")
    }

    /// The boxes of the gripper for an opening, in the gripper frame, millimetres; fingers first.
    pub(crate) fn boxes(&self, width: f64) -> [[[f64; 3]; 2]; 3] {
        let w = 0.5 * width;
        [
            [[w, -self.half, -self.length], [w + self.thick, self.half, 0.0]],
            [[-w - self.thick, -self.half, -self.length], [-w, self.half, 0.0]],
            self.body,
        ]
    }
}

pub(crate) type Corners = Vec<[[f64; 3]; 3]>;
pub(crate) type Block = [[f64; 3]; 2];

/// A union of boxes minus other boxes, millimetres.
#[derive(Clone)]
pub(crate) struct Solid {
    pub(crate) add: Vec<Block>,
    pub(crate) cut: Vec<Block>,
    lines: [Vec<f64>; 3],
    full: Vec<bool>,
}

impl Solid {
    pub(crate) fn new(add: Vec<Block>, cut: Vec<Block>) -> Self {
        let lines = [0, 1, 2].map(|k| {
            let mut v: Vec<f64> = add.iter().chain(&cut).flat_map(|b| [b[0][k], b[1][k]]).collect();
            v.sort_by(f64::total_cmp);
            v.dedup();
            v
        });
        Self::on(add, cut, lines)
    }

    /// The solid on a given lattice.
    fn on(add: Vec<Block>, cut: Vec<Block>, lines: [Vec<f64>; 3]) -> Self {
        let mut out = Self { add, cut, lines, full: Vec::new() };
        let n = [0, 1, 2].map(|k| out.lines[k].len() - 1);
        for i in 0..n[0] * n[1] * n[2] {
            let at = [i % n[0], i / n[0] % n[1], i / n[0] / n[1]];
            let p = [0, 1, 2].map(|k| 0.5 * (out.lines[k][at[k]] + out.lines[k][at[k] + 1]));
            let on = |b: &Block| (0..3).all(|k| p[k] > b[0][k] && p[k] < b[1][k]);
            out.full.push(out.add.iter().any(on) && !out.cut.iter().any(on));
        }
        out
    }

    fn size(&self) -> [usize; 3] {
        [0, 1, 2].map(|k| self.lines[k].len() - 1)
    }

    fn is(&self, at: [i64; 3]) -> bool {
        let n = self.size();
        (0..3).all(|k| at[k] >= 0 && (at[k] as usize) < n[k])
            && self.full[at[0] as usize + n[0] * (at[1] as usize + n[1] * at[2] as usize)]
    }

    /// The cells inside the solid.
    pub(crate) fn cells(&self) -> Vec<Block> {
        let n = self.size();
        (0..self.full.len())
            .filter(|i| self.full[*i])
            .map(|i| {
                let at = [i % n[0], i / n[0] % n[1], i / n[0] / n[1]];
                [[0, 1, 2].map(|k| self.lines[k][at[k]]), [0, 1, 2].map(|k| self.lines[k][at[k] + 1])]
            })
            .collect()
    }

    /// The surface as quads with outward normals.
    pub(crate) fn quads(&self) -> Vec<[[f64; 3]; 4]> {
        let n = self.size();
        let mut out = Vec::new();
        for i in 0..self.full.len() {
            let at = [i % n[0], i / n[0] % n[1], i / n[0] / n[1]].map(|v| v as i64);
            if !self.is(at) {
                continue;
            }
            for axis in 0..3 {
                for up in [false, true] {
                    let mut next = at;
                    next[axis] += if up { 1 } else { -1 };
                    if self.is(next) {
                        continue;
                    }
                    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
                    let corner = |a: usize, b: usize| {
                        let mut p = [0.0; 3];
                        p[axis] = self.lines[axis][at[axis] as usize + usize::from(up)];
                        p[u] = self.lines[u][at[u] as usize + a];
                        p[v] = self.lines[v][at[v] as usize + b];
                        p
                    };
                    let q = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
                    out.push(if up { q } else { [q[3], q[2], q[1], q[0]] });
                }
            }
        }
        out
    }

    /// Rectangles of the surface facing one side of an axis, each with its position along the axis.
    fn patches(&self, axis: usize, up: bool) -> Vec<(f64, Block)> {
        let n = self.size();
        let mut out = Vec::new();
        for i in 0..self.full.len() {
            let at = [i % n[0], i / n[0] % n[1], i / n[0] / n[1]];
            let mut next = at.map(|v| v as i64);
            next[axis] += if up { 1 } else { -1 };
            if self.full[i] && !self.is(next) {
                let b = [[0, 1, 2].map(|k| self.lines[k][at[k]]), [0, 1, 2].map(|k| self.lines[k][at[k] + 1])];
                out.push((b[usize::from(up)][axis], b));
            }
        }
        out
    }

    pub(crate) fn corners(&self) -> Corners {
        self.quads().iter().flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect()
    }

    /// A scan with triangles of very different sizes and shapes, as after decimation: cut along `n` random planes
    /// across each axis.
    pub(crate) fn uneven(&self, n: usize, noise: f64, seed: u64) -> Corners {
        use rand::RngExt;
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        let lines = self.lines.clone().map(|mut l| {
            let (lo, hi) = (l[0], l[l.len() - 1]);
            l.extend((0..n).map(|_| rng.random_range(lo..hi)));
            l.sort_by(f64::total_cmp);
            l
        });
        Self::on(self.add.clone(), self.cut.clone(), lines).scan(1e9, noise, seed)
    }

    /// A scan: the surface in triangles with sides of about `step` millimetres and Gaussian noise on each vertex.
    pub(crate) fn scan(&self, step: f64, noise: f64, seed: u64) -> Corners {
        use rand_distr::{Distribution, Normal};
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        let normal = Normal::new(0.0, noise).unwrap();
        let mut moved: HashMap<[i64; 3], [f64; 3]> = HashMap::new();
        let mut out = Vec::new();
        for q in self.quads() {
            let d = |a: [f64; 3], b: [f64; 3]| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>().sqrt();
            let n = |a, b| ((d(a, b) / step).round() as usize).max(1);
            let (nu, nv) = (n(q[0], q[1]), n(q[0], q[3]));
            let mut at = |i: usize, j: usize| {
                let (x, y) = (i as f64 / nu as f64, j as f64 / nv as f64);
                let p = [0, 1, 2].map(|k| q[0][k] + (q[1][k] - q[0][k]) * x + (q[3][k] - q[0][k]) * y);
                let key = p.map(|v| (v * 1e4).round() as i64);
                let d = *moved.entry(key).or_insert_with(|| [0; 3].map(|_| normal.sample(&mut rng)));
                [0, 1, 2].map(|k| p[k] + d[k])
            };
            for i in 0..nu {
                for j in 0..nv {
                    let c = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
                    let t = if (i + j) % 2 == 0 {
                        [[c[0], c[1], c[2]], [c[0], c[2], c[3]]]
                    } else {
                        [[c[0], c[1], c[3]], [c[1], c[2], c[3]]]
                    };
                    out.extend(t);
                }
            }
        }
        out
    }
}

/// The same triangles in another frame.
pub(crate) fn moved(t: &Corners, pose: &Pose) -> Corners {
    let at = |v: &[f64; 3]| <[f64; 3]>::from((pose * Point3::from(Vec3::from(*v) * 1e-3)).coords * 1e3);
    t.iter().map(|c| [at(&c[0]), at(&c[1]), at(&c[2])]).collect()
}

pub(crate) fn stl(t: &Corners) -> Vec<u8> {
    let mut out = vec![0u8; 80];
    out.extend((t.len() as u32).to_le_bytes());
    for c in t {
        out.extend([0u8; 12]);
        out.extend(c.iter().flatten().flat_map(|v| (*v as f32).to_le_bytes()));
        out.extend([0u8; 2]);
    }
    out
}

/// A prism over an outline (counter-clockwise, millimetres) from 0 to `height`, as an OBJ of polygons.
pub(crate) fn prism(outline: &[[f64; 2]], height: f64) -> String {
    let n = outline.len();
    let mut out = String::new();
    for z in [0.0, height] {
        for p in outline {
            out += &format!("v {} {} {z}\n", p[0], p[1]);
        }
    }
    out += &format!("f {}\n", (1..=n).rev().map(|k| k.to_string()).collect::<Vec<_>>().join(" "));
    out += &format!("f {}\n", (1..=n).map(|k| (n + k).to_string()).collect::<Vec<_>>().join(" "));
    for k in 0..n {
        let l = (k + 1) % n;
        out += &format!("f {} {} {} {}\n", k + 1, l + 1, n + l + 1, n + k + 1);
    }
    out
}

pub(crate) fn polygon(n: usize, radius: f64) -> Vec<[f64; 2]> {
    (0..n)
        .map(|k| (k as f64 * std::f64::consts::TAU / n as f64).sin_cos())
        .map(|(s, c)| [radius * c, radius * s])
        .collect()
}

/// A handle of the list, millimetres, in the mesh frame.
#[derive(Clone, Debug)]
pub(crate) struct Row {
    pub(crate) closing: Vec3,
    pub(crate) approach: Vec3,
    pub(crate) width: f64,
    pub(crate) opening: f64,
    pub(crate) contact: f64,
    pub(crate) mesh_from_gripper: Pose,
    /// Whether the gripper can be moved there, regardless of the visibility of its marks.
    pub(crate) free: bool,
    pub(crate) kind: String,
}

/// A temporary folder for each test, removed at its end.
pub(crate) struct Folder(pub(crate) PathBuf);

impl Folder {
    pub(crate) fn new(name: &str, jaw: &Jaw) -> Self {
        let path = std::env::temp_dir().join(format!("graspd-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        let f = Self(path);
        f.write("rig.toml", RIG);
        f.write("gripper.toml", jaw.toml());
        f.write(
            "pose.toml",
            "schema = \"graspd-pose/1\"\nsigma_mm = 0.2\nsigma_deg = 0.1\n[left_from_mesh]\ntranslation_m = [0.0, 0.0, 1.3]\nrotation_vector_rad = [2.2, 0.4, 0.3]\n",
        );
        f
    }

    pub(crate) fn write(&self, name: &str, content: impl AsRef<[u8]>) -> PathBuf {
        let path = self.0.join(name);
        std::fs::write(&path, content).unwrap();
        path
    }

    pub(crate) fn request(&self, mesh: &Path) -> MeshRequest {
        MeshRequest {
            mesh: mesh.to_owned(),
            unit: "mm".to_owned(),
            rig: self.0.join("rig.toml"),
            gripper: self.0.join("gripper.toml"),
            mesh_pose: Some(self.0.join("pose.toml")),
            clearance: Some(CLEARANCE * 1e-3),
            contact_mm2: Some(CONTACT),
            pregrasp: Some(APPROACH * 1e-3),
            list: true,
            ..Default::default()
        }
    }

    pub(crate) fn list(&self, mesh: &Path) -> Vec<Row> {
        let o = run(&self.request(mesh));
        if o.class != Class::Done {
            panic!("{}", o.text);
        }
        rows(&o.json)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

pub(crate) fn rows(json: &serde_json::Value) -> Vec<Row> {
    let v = |r: &serde_json::Value| Vec3::from_fn(|i, _| r[i].as_f64().unwrap());
    let f = |r: &serde_json::Value| r.as_f64().unwrap() * 1e3;
    let all = json["handles"].as_array().unwrap();
    all.iter()
        .map(|r| {
            let pose = &r["mesh_from_gripper"];
            let q: Vec<f64> = (0..4).map(|k| pose["quaternion_wxyz"][k].as_f64().unwrap()).collect();
            let kind = r["kind"].as_str().unwrap_or("").to_owned();
            Row {
                closing: v(&r["closing"]),
                approach: v(&r["approach"]),
                width: f(&r["width_m"]),
                opening: f(&r["opening_m"]),
                contact: f(&r["contact_m2"]) * 1e3,
                mesh_from_gripper: Pose::from_parts(
                    v(&pose["translation_m"]).into(),
                    UnitQuaternion::new_normalize(Quaternion::new(q[0], q[1], q[2], q[3])),
                ),
                free: kind.is_empty() || kind == "with too few marks seen",
                kind,
            }
        })
        .collect()
}

/// Clearance of each claw, millimetres.
pub(crate) const CLEARANCE: f64 = 1.5;
/// Smallest contact of each claw, square millimetres.
pub(crate) const CONTACT: f64 = 40.0;
/// Length of the approach, millimetres.
pub(crate) const APPROACH: f64 = 50.0;

/// A grasp with its axes along those of the part: axis of closing, axis and sign of the approach, and the positions of
/// the two faces in tenths of a millimetre.
pub(crate) type Key = (usize, usize, bool, i64, i64);

pub(crate) fn key(r: &Row) -> Key {
    let (c, a) = (r.closing.abs().imax(), r.approach.abs().imax());
    let at = r.mesh_from_gripper.translation.vector[c] * 1e3;
    let tenth = |v: f64| (v * 10.0).round() as i64;
    (c, a, r.approach[a] > 0.0, tenth(at - 0.5 * r.width), tenth(at + 0.5 * r.width))
}

/// All axis-parallel grasps of a solid of boxes, by exhaustive search with steps of a millimetre. Contact and
/// collisions of boxes with boxes are exact. With `strict` they need a little more contact and clearance than the plan,
/// otherwise a little less.
pub(crate) fn brute(solid: &Solid, jaw: &Jaw, strict: bool) -> BTreeSet<Key> {
    let more = if strict { 1.0 } else { -1.0 };
    let cells = solid.cells();
    let mut out = BTreeSet::new();
    let meets = |b: &Block| cells.iter().any(|c| (0..3).all(|k| c[0][k] < b[1][k] && c[1][k] > b[0][k]));
    for (c, a, plus) in (0..3).flat_map(|c| {
        [(c, (c + 1) % 3, true), (c, (c + 1) % 3, false), (c, (c + 2) % 3, true), (c, (c + 2) % 3, false)]
    }) {
        let b = 3 - c - a;
        let sign = if plus { 1.0 } else { -1.0 };
        let patches = [true, false].map(|up| solid.patches(c, up));
        let planes =
            patches.clone().map(|p| p.iter().map(|(at, _)| (at * 10.0).round() as i64).collect::<BTreeSet<_>>());
        for (top, bottom) in
            planes[0].iter().flat_map(|t| planes[1].iter().map(move |b| (*t, *b))).filter(|(t, b)| t > b)
        {
            let on = |k: usize, plane: i64| {
                patches[k].iter().filter(move |(at, _)| (at * 10.0).round() as i64 == plane).map(|p| p.1)
            };
            // The overlap of both faces, as rectangles across and along the approach.
            let shared: Vec<[[f64; 2]; 2]> = on(0, top)
                .flat_map(|p| {
                    on(1, bottom).map(move |q| {
                        [[0, 1, 2].map(|k| p[0][k].max(q[0][k])), [0, 1, 2].map(|k| p[1][k].min(q[1][k]))]
                    })
                })
                .filter(|r: &Block| r[1][a] > r[0][a] + 1e-9 && r[1][b] > r[0][b] + 1e-9)
                .map(|r| {
                    let (x, y) = (sign * r[0][a], sign * r[1][a]);
                    [[r[0][b], x.min(y)], [r[1][b], x.max(y)]]
                })
                .collect();
            let (t, u) = (top as f64 * 0.1, bottom as f64 * 0.1);
            let opening = t - u + 2.0 * CLEARANCE;
            if shared.is_empty() || opening > jaw.max - 0.2 * more || t - u < 1.0 {
                continue;
            }
            let range = |k: usize| {
                shared.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), r| (l.min(r[0][k]), h.max(r[1][k])))
            };
            let (across, along) = (range(0), range(1));
            // The gripper's y is approach x closing; half a turn reverses x and y.
            let y = if (a + 1) % 3 == c { sign } else { -sign };
            let free = |side: f64, tip: f64| {
                let pad = [[side - jaw.half, tip - jaw.length], [side + jaw.half, tip]];
                let common = |r: &[[f64; 2]; 2]| -> f64 {
                    (0..2).map(|k| (r[1][k].min(pad[1][k]) - r[0][k].max(pad[0][k])).max(0.0)).product()
                };
                if shared.iter().map(common).sum::<f64>() < CONTACT * (1.0 + 0.3 * more) {
                    return false;
                }
                let near = shared
                    .iter()
                    .filter(|r| r[0][0] < pad[1][0] && r[1][0] > pad[0][0])
                    .map(|r| r[0][1])
                    .fold(f64::INFINITY, f64::min);
                if strict && tip - near > jaw.length - 1.3 {
                    return false;
                }
                let moved = |q: &Block, travel: f64, margin: f64, roll: f64| {
                    let mut out = [[0.0; 3]; 2];
                    let mut put = |axis: usize, at: f64, s: f64, l: f64, h: f64| {
                        let (p, r) = (at + s * l, at + s * h);
                        (out[0][axis], out[1][axis]) = (p.min(r) - margin, p.max(r) + margin);
                    };
                    put(c, 0.5 * (t + u), roll, q[0][0], q[1][0]);
                    put(b, side, y * roll, q[0][1], q[1][1]);
                    put(a, sign * tip, sign, q[0][2] - travel, q[1][2]);
                    out
                };
                [1.0, -1.0].iter().any(|roll| {
                    let approach =
                        jaw.boxes(opening).iter().all(|q| !meets(&moved(q, APPROACH, 0.5 + 0.2 * more, *roll)));
                    approach
                        && jaw.boxes(t - u + 1.0 - 0.6 * more)[..2].iter().all(|q| !meets(&moved(q, 0.0, 0.0, *roll)))
                })
            };
            let steps = |(l, h): (f64, f64)| (0..=((h - l) as i64)).map(move |k| l + k as f64);
            if steps(across).any(|side| steps(along).any(|tip| free(side, tip))) {
                out.insert((c, a, plus, bottom, top));
            }
        }
    }
    out
}
