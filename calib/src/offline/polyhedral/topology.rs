//! Which triangles meet at which edge, whether they agree on what is outside, and turning them where they do not.

use super::bvh::Bvh;
use super::mesh::Mesh;
use graspd_rt::geom::Vec3;

/// An edge with the one or two triangles that meet there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Edge {
    /// Its ends, indices of vertices, the lower first.
    pub ends: [u32; 2],
    /// A triangle at it.
    pub one: u32,
    /// The other; `None` at an open edge and at one where more than two meet.
    pub other: Option<u32>,
    /// Whether the two run along it in opposite directions, as neighbours with one outside do.
    pub agree: bool,
}

/// What was found, and mended.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Topology {
    /// Triangles turned to agree with their neighbours.
    pub turned: usize,
    /// Whether the whole mesh was inside out.
    pub inside_out: bool,
    /// Edges with one triangle.
    pub open: usize,
    /// Edges with more than two.
    pub crowded: usize,
    /// Edges whose triangles cannot be made to agree.
    pub one_sided: usize,
}

/// Every edge of a mesh.
pub fn edges(mesh: &Mesh) -> Vec<Edge> {
    let mut out = Vec::with_capacity(mesh.triangles.len() * 3 / 2);
    groups(mesh, |ends, sides| match sides {
        [(t, d), (u, e)] => out.push(Edge { ends, one: *t, other: Some(*u), agree: d != e }),
        _ => out.extend(sides.first().map(|(t, _)| Edge { ends, one: *t, other: None, agree: true })),
    });
    out
}

/// Calls `each` with every edge and its triangles, each with whether it runs from the lower to the higher vertex.
fn groups(mesh: &Mesh, mut each: impl FnMut([u32; 2], &[(u32, bool)])) {
    let mut sides: Vec<([u32; 2], (u32, bool))> = Vec::with_capacity(3 * mesh.triangles.len());
    for (t, [a, b, c]) in mesh.triangles.iter().enumerate() {
        for (p, q) in [(*a, *b), (*b, *c), (*c, *a)] {
            sides.push(([p.min(q), p.max(q)], (t as u32, p < q)));
        }
    }
    sides.sort_unstable();
    let mut here = Vec::new();
    for group in sides.chunk_by(|x, y| x.0 == y.0) {
        here.clear();
        here.extend(group.iter().map(|s| s.1));
        if let Some((ends, _)) = group.first() {
            each(*ends, &here);
        }
    }
}

/// Turns triangles so that neighbours agree (the fewer of each piece are turned), then every piece that is inside out.
pub fn mend(mesh: &mut Mesh) -> Topology {
    let mut found = Topology::default();
    let n = mesh.triangles.len();
    let mut near: Vec<Vec<(u32, bool)>> = vec![Vec::new(); n];
    let mut whole = vec![true; n];
    groups(mesh, |_, sides| match sides {
        [(t, d), (u, e)] => {
            for (x, y) in [(*t, *u), (*u, *t)] {
                if let Some(list) = near.get_mut(x as usize) {
                    list.push((y, d != e));
                }
            }
        }
        _ => {
            match sides {
                [_] => found.open += 1,
                _ => found.crowded += 1,
            }
            for (t, _) in sides {
                if let Some(w) = whole.get_mut(*t as usize) {
                    *w = false;
                }
            }
        }
    });
    let mut turn = vec![None; n];
    let mut pieces = Vec::new();
    for first in 0..n as u32 {
        if turn.get(first as usize).is_some_and(Option::is_none) {
            pieces.push(agree(first, &near, &mut turn, &mut found));
        }
    }
    // Each such edge was met from both sides.
    found.one_sided /= 2;
    for (t, flip) in mesh.triangles.iter_mut().zip(&turn) {
        if *flip == Some(true) {
            t.swap(1, 2);
            found.turned += 1;
        }
    }
    let inwards = inwards(mesh, &pieces, &whole);
    found.inside_out = !inwards.is_empty() && inwards.len() == pieces.len();
    for t in inwards.iter().filter_map(|k| pieces.get(*k)).flatten() {
        if let Some(t) = mesh.triangles.get_mut(*t as usize) {
            t.swap(1, 2);
        }
        found.turned += usize::from(!found.inside_out);
    }
    found
}

/// Walks a piece from its first triangle and marks which of them have to be turned so that all agree: the fewer ones. Returns the piece.
fn agree(first: u32, near: &[Vec<(u32, bool)>], turn: &mut [Option<bool>], found: &mut Topology) -> Vec<u32> {
    let mut piece = vec![first];
    let mut next = 0;
    if let Some(t) = turn.get_mut(first as usize) {
        *t = Some(false);
    }
    while let Some(t) = piece.get(next).copied() {
        next += 1;
        let own = turn.get(t as usize).copied().flatten().unwrap_or(false);
        for (u, agree) in near.get(t as usize).into_iter().flatten() {
            // A neighbour that agrees is turned when this one is; one that disagrees when this one is not.
            let wanted = own == *agree;
            match turn.get_mut(*u as usize) {
                Some(slot @ None) => {
                    *slot = Some(wanted);
                    piece.push(*u);
                }
                Some(Some(is)) if *is != wanted => found.one_sided += 1,
                _ => {}
            }
        }
    }
    let against = piece.iter().filter(|t| turn.get(**t as usize).copied().flatten() == Some(true)).count();
    if 2 * against > piece.len() {
        for t in &piece {
            if let Some(Some(x)) = turn.get_mut(*t as usize) {
                *x = !*x;
            }
        }
    }
    piece
}

/// Pieces of a mesh that are asked for their own inside at most: more are crumbs of a broken file, and only judged together.
const MOST_PIECES: usize = 3000;

/// Which pieces of a mesh are wound inwards.
///
/// A closed piece says so by the sign of its own volume, unless it is a hollow within another one: that goes with the piece round it. A piece
/// with open edges is a part of a surface that other pieces complete: rays from either side of it count what they meet.
fn inwards(mesh: &Mesh, pieces: &[Vec<u32>], whole: &[bool]) -> Vec<usize> {
    let all = |mesh: &Mesh| {
        if volume(mesh, 0..mesh.triangles.len() as u32) < 0.0 { (0..pieces.len()).collect() } else { Vec::new() }
    };
    if pieces.len() == 1 || pieces.len() > MOST_PIECES {
        return all(mesh);
    }
    let tree = Bvh::new(mesh);
    let mut piece_of = vec![0u32; mesh.triangles.len()];
    for (k, piece) in pieces.iter().enumerate() {
        for t in piece {
            if let Some(p) = piece_of.get_mut(*t as usize) {
                *p = k as u32;
            }
        }
    }
    let of = |t: u32| piece_of.get(t as usize).copied().unwrap_or(0);
    let (mut out, mut hollow, mut outer) = (Vec::new(), Vec::new(), 0usize);
    for (k, piece) in pieces.iter().enumerate() {
        let samples = piece.iter().step_by((piece.len() / 9).max(1));
        let centre = |t: u32| mesh.corners(t as usize).iter().sum::<Vec3>() / 3.0;
        if piece.iter().all(|t| whole.get(*t as usize).copied().unwrap_or(false)) {
            // Most of its surface, because pieces of a part may also reach into each other.
            let (mut within, mut n) = (0, 0);
            for t in samples {
                n += 1;
                within += usize::from(tree.odd(&centre(*t), |u| of(u) as usize != k));
            }
            if within == n {
                hollow.push(k);
                continue;
            }
            outer += 1;
            if volume(mesh, piece.iter().copied()) < 0.0 {
                out.push(k);
            }
            continue;
        }
        outer += 1;
        let skin = 1e-6 * mesh.size().norm();
        let (mut inside, mut outside) = (0, 0);
        for t in samples {
            let [a, b, c] = mesh.corners(*t as usize);
            let Some(normal) = (b - a).cross(&(c - a)).try_normalize(0.0) else { continue };
            // Before the surface and behind it: where the two do not differ, the mesh is no solid there.
            let [before, behind] = [skin, -skin].map(|s| tree.odd(&(centre(*t) + normal * s), |_| true));
            inside += usize::from(before && !behind);
            outside += usize::from(!before && behind);
        }
        if inside > outside {
            out.push(k);
        }
    }
    // A mesh that is inside out as a whole is so in its hollows too.
    if outer > 0 && out.len() == outer {
        out.extend(hollow);
    }
    out
}

/// Volume enclosed by some triangles (of an open surface: with the mesh's centre for the missing part).
fn volume(mesh: &Mesh, of: impl IntoIterator<Item = u32>) -> f64 {
    let c = mesh.centre();
    of.into_iter()
        .map(|t| {
            let [p, q, r] = mesh.corners(t as usize).map(|v| v - c);
            p.dot(&q.cross(&r)) / 6.0
        })
        .sum()
}
