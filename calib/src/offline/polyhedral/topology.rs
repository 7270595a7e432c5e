//! Which triangles meet at which edge, whether they agree on what is outside, and turning them where they do not.

use super::mesh::Mesh;

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

/// Turns triangles so that neighbours agree (the fewer of each piece are turned), then the whole mesh if its volume comes out negative.
pub fn mend(mesh: &mut Mesh) -> Topology {
    let mut found = Topology::default();
    let n = mesh.triangles.len();
    let mut near: Vec<Vec<(u32, bool)>> = vec![Vec::new(); n];
    groups(mesh, |_, sides| match sides {
        [(t, d), (u, e)] => {
            for (x, y) in [(*t, *u), (*u, *t)] {
                if let Some(list) = near.get_mut(x as usize) {
                    list.push((y, d != e));
                }
            }
        }
        [_] => found.open += 1,
        _ => found.crowded += 1,
    });
    // Walk each piece: a triangle that disagrees with the one it was reached from is marked as turned against the piece's first.
    let mut turn: Vec<Option<bool>> = vec![None; n];
    for first in 0..n {
        if turn.get(first).copied().flatten().is_some() {
            continue;
        }
        let mut piece = vec![first];
        let mut next = 0;
        if let Some(t) = turn.get_mut(first) {
            *t = Some(false);
        }
        while let Some(t) = piece.get(next).copied() {
            next += 1;
            let own = turn.get(t).copied().flatten().unwrap_or(false);
            for (u, agree) in near.get(t).into_iter().flatten() {
                // A neighbour that agrees is turned when this one is; one that disagrees when this one is not.
                let wanted = own == *agree;
                let u = *u as usize;
                match turn.get_mut(u) {
                    Some(slot @ None) => {
                        *slot = Some(wanted);
                        piece.push(u);
                    }
                    Some(Some(is)) if *is != wanted => found.one_sided += 1,
                    _ => {}
                }
            }
        }
        let against = piece.iter().filter(|t| turn.get(**t).copied().flatten() == Some(true)).count();
        if 2 * against > piece.len() {
            for t in &piece {
                if let Some(Some(x)) = turn.get_mut(*t) {
                    *x = !*x;
                }
            }
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
    if volume(mesh) < 0.0 {
        for t in &mut mesh.triangles {
            t.swap(1, 2);
        }
        found.inside_out = true;
    }
    found
}

/// Volume enclosed (of an open mesh: with its surface's centre for the missing part).
fn volume(mesh: &Mesh) -> f64 {
    let c = mesh.centre();
    (0..mesh.triangles.len())
        .map(|t| {
            let [p, q, r] = mesh.corners(t).map(|v| v - c);
            p.dot(&q.cross(&r)) / 6.0
        })
        .sum()
}
