//! Mesh files: valid ones in every dialect, and every kind of damage.

use super::*;
use std::fmt::Write as _;

type Corners = Vec<[[f32; 3]; 3]>;

fn cube() -> Corners {
    let p = |i: usize| [0, 1, 2].map(|k| if i >> k & 1 == 1 { 20.0f32 } else { -20.0 });
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    quads.iter().flat_map(|q| [[p(q[0]), p(q[1]), p(q[2])], [p(q[0]), p(q[2]), p(q[3])]]).collect()
}

fn binary(t: &Corners) -> Vec<u8> {
    // Many exporters begin a binary file with the keyword of a text file.
    let mut out = b"solid of somebody's exporter".to_vec();
    out.resize(80, b' ');
    out.extend((t.len() as u32).to_le_bytes());
    for c in t {
        out.extend([0u8; 12]);
        out.extend(c.iter().flatten().flat_map(|v| v.to_le_bytes()));
        out.extend([0u8; 2]);
    }
    out
}

fn text(t: &Corners) -> String {
    let mut out = String::from("solid cube\n");
    for c in t {
        out += "  facet normal 0 0 0\n    outer loop\n";
        for v in c {
            let _ = writeln!(out, "      vertex {:e} {:e} {:e}", v[0], v[1], v[2]);
        }
        out += "    endloop\n  endfacet\n";
    }
    out + "endsolid cube\n"
}

const QUADS: &str = "# a cube of quads, counted from both ends\nmtllib none.mtl\no cube\nv -20 -20 -20 1.0\nv 20 -20 -20\nv -20 20 -20\nv 20 20 -20\n\
v -20 -20 20\nv 20 -20 20\nv -20 20 20\nv 20 20 \\\n20\nvt 0 0\nvn 0 0 1\nusemtl x\nf 1/1/1 3/1/1 4/1/1 2/1/1\nf 5//1 6//1 8//1 7//1\nf 1 2 6 5\nf -6 -2 -1 -5\nf 1 5 7 3\nf 2 4 8 6\n";

#[test]
fn every_dialect_gives_the_same_cube_and_agrees_with_other_readers() {
    let a = parse(&binary(&cube()), "stl", 1e-3).unwrap();
    let b = parse(text(&cube()).as_bytes(), "stl", 1e-3).unwrap();
    let c = parse(QUADS.as_bytes(), "obj", 1e-3).unwrap();
    for m in [&a, &b, &c] {
        assert_eq!((m.mesh.vertices.len(), m.mesh.triangles.len()), (8, 12));
        assert!((m.size - Vec3::repeat(0.04)).norm() < 1e-12);
        assert_eq!(m.notes, Vec::<String>::new());
    }
    assert_eq!(a.mesh, b.mesh);
    assert_ne!(a.hash, b.hash);
    for bytes in [binary(&cube()), text(&cube()).into_bytes()] {
        let peer = stl_io::read_stl(&mut std::io::Cursor::new(&bytes)).unwrap();
        let ours = stl::read(&bytes).unwrap();
        assert_eq!(peer.faces.len(), ours.len());
        for (f, t) in peer.faces.iter().zip(&ours) {
            for (i, v) in f.vertices.iter().zip(t) {
                assert_eq!([v.x as f32, v.y as f32, v.z as f32], <[f32; 3]>::from(peer.vertices[*i]));
            }
        }
    }
    let options = tobj::LoadOptions { triangulate: true, ..Default::default() };
    let (models, _) = tobj::load_obj_buf(&mut QUADS.replace("\\\n", "").as_bytes(), &options, |_| {
        Err(tobj::LoadError::OpenFileFailed)
    })
    .unwrap();
    assert_eq!(models.iter().map(|m| m.mesh.indices.len() / 3).sum::<usize>(), c.mesh.triangles.len());
}

#[test]
fn damaged_files_are_refused_with_position_and_reason() {
    let whole = binary(&cube());
    let with = |at: usize, bytes: &[u8]| {
        let mut b = whole.clone();
        b[at..at + bytes.len()].copy_from_slice(bytes);
        b
    };
    let t = text(&cube());
    let cases: Vec<(Vec<u8>, &str, &str)> = vec![
        (vec![], "stl", "it is empty"),
        (whole[..40].to_vec(), "stl", "byte 40"),
        (whole[..whole.len() - 1].to_vec(), "stl", "byte 683: the file ends there, but the 12 triangles"),
        (with(80, &3u32.to_le_bytes()), "stl", "byte 234: 450 more bytes"),
        (with(80, &u32::MAX.to_le_bytes()), "stl", "4294967295 triangles"),
        (with(84 + 50 + 12, &f32::NAN.to_le_bytes()), "stl", "byte 134: triangle 1"),
        (with(84 + 24, &f32::INFINITY.to_le_bytes()), "stl", "byte 84: triangle 0"),
        (binary(&vec![]), "stl", "no triangle"),
        (binary(&vec![[[1.0; 3]; 3]]), "stl", "has an area"),
        (t.as_bytes()[..t.len() / 2].to_vec(), "stl", "line "),
        (t.replace("endsolid cube\n", "").into_bytes(), "stl", "ends inside a solid"),
        (t.replacen("vertex -2e1", "vertex nan", 1).into_bytes(), "stl", "line 4: \"vertex nan"),
        (
            t.replacen("    endloop\n", "      vertex 1 2 3\n    endloop\n", 1).into_bytes(),
            "stl",
            "line 9: the facet that ends here has 4 corners",
        ),
        (t.replacen("  endfacet\n", "", 1).into_bytes(), "stl", "a facet begins inside another"),
        (b"solid empty\nendsolid empty\n".to_vec(), "stl", "no triangle"),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\n".to_vec(), "obj", "no triangle"),
        (b"v 0 0\n".to_vec(), "obj", "line 1"),
        (b"v 0 0 0\nv 1 0 0\nv 0 inf 0\nf 1 2 3\n".to_vec(), "obj", "line 3"),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n".to_vec(), "obj", "line 4: the face names vertex 4"),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 0\n".to_vec(), "obj", "vertex 0"),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -9\n".to_vec(), "obj", "vertex -9"),
        (b"v 0 0 0\nv 1 0 0\nf 1 2\n".to_vec(), "obj", "line 3: a face has 2 corners"),
        (b"v 0 0 0\nf a b c\n".to_vec(), "obj", "line 2"),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 \\\n".to_vec(), "obj", "line 4: the file ends inside"),
        (whole.clone(), "step", "neither in .stl nor in .obj"),
    ];
    for (bytes, kind, message) in cases {
        let e = parse(&bytes, kind, 1e-3).unwrap_err();
        assert!(e.reason.contains(message), "{message}: {e:?}");
        assert!(!e.fix.is_empty());
    }
    for (unit_m, large) in [(1.0, "40.0000"), (1e-6, "0.0000")] {
        let e = parse(&whole, "stl", unit_m).unwrap_err();
        assert!(e.reason.contains(large) && e.fix.contains("--mesh-unit"), "{e:?}");
    }
}

#[test]
fn cut_and_altered_files_never_panic() {
    use rand::{RngExt, SeedableRng};
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(3);
    let sources = [(binary(&cube()), "stl"), (text(&cube()).into_bytes(), "stl"), (QUADS.as_bytes().to_vec(), "obj")];
    let mut read = 0;
    for k in 0..6000 {
        let (bytes, kind) = &sources[k % 3];
        let mut b = bytes.clone();
        for _ in 0..rng.random_range(1..4) {
            let at = rng.random_range(0..b.len());
            b[at] = rng.random_range(0..=255u8);
        }
        if k % 2 == 0 {
            b.truncate(rng.random_range(0..=b.len()));
        }
        read += usize::from(parse(&b, kind, 1e-3).is_ok());
    }
    assert!(read > 0 && read < 6000, "{read}");
}

#[test]
fn windings_are_corrected_and_defects_are_noted() {
    let flip = |t: &mut [[f32; 3]; 3]| t.swap(1, 2);
    let good = parse(&binary(&cube()), "stl", 1e-3).unwrap();
    let mut some = cube();
    some.iter_mut().step_by(4).for_each(flip);
    let corrected = parse(&binary(&some), "stl", 1e-3).unwrap();
    assert!(corrected.notes.iter().any(|n| n.contains("3 triangles were wound against")), "{:?}", corrected.notes);
    let mut all = cube();
    all.iter_mut().for_each(flip);
    let turned = parse(&binary(&all), "stl", 1e-3).unwrap();
    assert!(turned.notes.iter().any(|n| n.contains("pointed inwards")));
    let outward = |m: &Mesh| {
        (0..m.triangles.len()).all(|t| {
            let [a, b, c] = m.corners(t);
            (b - a).cross(&(c - a)).dot(&a) > 0.0
        })
    };
    assert!(outward(&good.mesh) && outward(&corrected.mesh) && outward(&turned.mesh));
    let open = parse(&binary(&cube()[..10].to_vec()), "stl", 1e-3).unwrap();
    assert!(open.notes.iter().any(|n| n.contains("4 open edges")), "{:?}", open.notes);
    // A duplicate triangle, a degenerate one, and a fin on an edge.
    let mut double = cube();
    double.push(cube()[0]);
    double.push([[5.0; 3]; 3]);
    double.push([cube()[0][0], cube()[0][1], [-30.0, 0.0, -30.0]]);
    let notes = parse(&binary(&double), "stl", 1e-3).unwrap().notes;
    assert!(
        notes.iter().any(|n| n.contains("1 edges join more than two")) && notes.iter().any(|n| n.contains("2 of 15")),
        "{notes:?}"
    );
}

#[test]
fn concave_polygons_are_triangulated_within_their_outline() {
    // An L-shaped polygon of area 3, starting at each of its corners.
    let l = [[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]];
    for from in 0..6 {
        let mut obj = String::new();
        for k in 0..6 {
            let [x, y] = l[(from + k) % 6];
            let _ = writeln!(obj, "v {x} {y} 0.5");
        }
        obj += "f 1 2 3 4 5 6\n";
        let t = obj::read(obj.as_bytes()).unwrap();
        let area: f64 = t.iter().map(|[a, b, c]| 0.5 * (b - a).cross(&(c - a)).z).sum();
        let covered: f64 = t.iter().map(|[a, b, c]| 0.5 * (b - a).cross(&(c - a)).norm()).sum();
        assert!((area - 3.0).abs() < 1e-12 && (covered - 3.0).abs() < 1e-12, "{from}: {area} {covered}");
    }
    let star = "v 0 0 0\nv 3 3 0\nv 3 0 0\nv 0 3.5 0\nf 1 2 3 4\n";
    assert!(obj::read(star.as_bytes()).unwrap_err().reason.contains("crosses itself"));
}

#[test]
fn components_and_cavities_are_oriented_separately() {
    let at = |t: Corners, s: f32, d: f32| -> Corners {
        t.iter().map(|t| t.map(|v| [v[0] * s + d, v[1] * s, v[2] * s])).collect()
    };
    let flip = |t: Corners| -> Corners { t.iter().map(|t| [t[0], t[2], t[1]]).collect() };
    let volume = |t: &Corners| {
        let m = parse(&binary(t), "stl", 1e-3).unwrap().mesh;
        (0..m.triangles.len()).map(|t| m.corners(t)).map(|[a, b, c]| a.dot(&b.cross(&c)) / 6.0 * 1e6).sum::<f64>()
    };
    // Two separate cubes of 64 and 8 cm3, one of them inside out: their volumes add. A cavity of 8 cm3 is subtracted,
    // for either orientation of the whole mesh.
    let (large, small) = (at(cube(), 1.0, 0.0), at(cube(), 0.5, 60.0));
    for t in [[large.clone(), flip(small.clone())].concat(), [flip(large.clone()), small].concat()] {
        assert!((volume(&t) - 72.0).abs() < 1e-3, "{}", volume(&t));
    }
    let hollow = [large, flip(at(cube(), 0.5, 0.0))].concat();
    assert!((volume(&hollow) - 56.0).abs() < 1e-3 && (volume(&flip(hollow)) - 56.0).abs() < 1e-3);
    // Six faces that share no corner (each a few micrometres from the next), every second one wound inwards: still a
    // cube.
    let mut loose = cube();
    for (k, t) in loose.iter_mut().enumerate() {
        *t = t.map(|v| v.map(|x| x * (1.0 + 1e-4 * (k / 2) as f32)));
        if k / 2 % 2 == 0 {
            t.swap(1, 2);
        }
    }
    assert!((volume(&loose) - 64.0).abs() < 0.1, "{}", volume(&loose));
}
