//! Edges of a mesh, and the consistent orientation of its triangles.

use super::bvh::Bvh;
use super::mesh::Mesh;
use graspd_rt::geom::Vec3;

/// An edge with the one or two triangles that meet there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Edge {
    /// Indices of its vertices, the lower first.
    pub ends: [u32; 2],
    /// The first triangle at the edge.
    pub one: u32,
    /// The second triangle; `None` at an open edge and at one where more than two triangles meet.
    pub other: Option<u32>,
    /// Whether the triangles traverse the edge in opposite directions, as consistently oriented neighbours do.
    pub agree: bool,
}

/// The defects found by [`orient`], most of which it corrects.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Topology {
    /// Number of triangles reversed to agree with their neighbours.
    pub turned: usize,
    /// Whether the whole mesh was inside out.
    pub inside_out: bool,
    /// Number of edges with one triangle.
    pub open: usize,
    /// Number of edges with more than two triangles.
    pub crowded: usize,
    /// Number of edges whose triangles cannot be oriented consistently.
    pub one_sided: usize,
}

/// All edges of a mesh.
pub fn edges(mesh: &Mesh) -> Vec<Edge> {
    let mut out = Vec::with_capacity(mesh.triangles.len() * 3 / 2);
    groups(mesh, |ends, sides| match sides {
        [(t, d), (u, e)] => out.push(Edge { ends, one: *t, other: Some(*u), agree: d != e }),
        _ => out.extend(sides.first().map(|(t, _)| Edge { ends, one: *t, other: None, agree: true })),
    });
    out
}

/// Calls `each` with every edge and its triangles, each with whether it traverses the edge from the lower vertex to the
/// higher.
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

/// Orients the triangles: first consistently within each connected component (the minority is reversed), then every
/// component that is inside out.
pub fn orient(mesh: &mut Mesh) -> Topology {
    let mut found = Topology::default();
    let n = mesh.triangles.len();
    let mut near: Vec<Vec<(u32, bool)>> = vec![Vec::new(); n];
    let mut closed = vec![true; n];
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
                if let Some(w) = closed.get_mut(*t as usize) {
                    *w = false;
                }
            }
        }
    });
    let mut turn = vec![None; n];
    let mut components = Vec::new();
    for first in 0..n as u32 {
        if turn.get(first as usize).is_some_and(Option::is_none) {
            components.push(orient_component(first, &near, &mut turn, &mut found));
        }
    }
    // Each such edge was counted from both sides.
    found.one_sided /= 2;
    for (t, flip) in mesh.triangles.iter_mut().zip(&turn) {
        if *flip == Some(true) {
            t.swap(1, 2);
            found.turned += 1;
        }
    }
    let inwards = inwards(mesh, &components, &closed);
    found.inside_out = !inwards.is_empty() && inwards.len() == components.len();
    for t in inwards.iter().filter_map(|k| components.get(*k)).flatten() {
        if let Some(t) = mesh.triangles.get_mut(*t as usize) {
            t.swap(1, 2);
        }
        found.turned += usize::from(!found.inside_out);
    }
    found
}

/// Collects the component of a triangle and marks in `turn` the minority of its triangles that has to be reversed so
/// that all agree.
fn orient_component(
    first: u32,
    near: &[Vec<(u32, bool)>],
    turn: &mut [Option<bool>],
    found: &mut Topology,
) -> Vec<u32> {
    let mut component = vec![first];
    let mut next = 0;
    if let Some(t) = turn.get_mut(first as usize) {
        *t = Some(false);
    }
    while let Some(t) = component.get(next).copied() {
        next += 1;
        let own = turn.get(t as usize).copied().flatten().unwrap_or(false);
        for (u, agree) in near.get(t as usize).into_iter().flatten() {
            // A neighbour that agrees is reversed with this triangle; one that disagrees is reversed if this one is
            // not.
            let required = own == *agree;
            match turn.get_mut(*u as usize) {
                Some(slot @ None) => {
                    *slot = Some(required);
                    component.push(*u);
                }
                Some(Some(is)) if *is != required => found.one_sided += 1,
                _ => {}
            }
        }
    }
    let against = component.iter().filter(|t| turn.get(**t as usize).copied().flatten() == Some(true)).count();
    if 2 * against > component.len() {
        for t in &component {
            if let Some(Some(x)) = turn.get_mut(*t as usize) {
                *x = !*x;
            }
        }
    }
    component
}

/// Most components that are tested separately; a mesh with more is a damaged file, and is tested as a whole.
const MAX_COMPONENTS: usize = 3000;

/// The components of a mesh whose normals point inwards.
///
/// For a closed component the sign of its volume decides, unless it is a cavity inside another one: a cavity is
/// reversed only with the whole mesh. A component with open edges is a part of a surface that others complete: the
/// parity of ray crossings on both sides of it decides.
fn inwards(mesh: &Mesh, components: &[Vec<u32>], closed: &[bool]) -> Vec<usize> {
    let all = |mesh: &Mesh| {
        if volume(mesh, 0..mesh.triangles.len() as u32) < 0.0 { (0..components.len()).collect() } else { Vec::new() }
    };
    if components.len() == 1 || components.len() > MAX_COMPONENTS {
        return all(mesh);
    }
    let tree = Bvh::new(mesh);
    let mut component_of = vec![0u32; mesh.triangles.len()];
    for (k, component) in components.iter().enumerate() {
        for t in component {
            if let Some(p) = component_of.get_mut(*t as usize) {
                *p = k as u32;
            }
        }
    }
    let of = |t: u32| component_of.get(t as usize).copied().unwrap_or(0);
    let (mut out, mut cavities, mut outer) = (Vec::new(), Vec::new(), 0usize);
    for (k, component) in components.iter().enumerate() {
        let samples = component.iter().step_by((component.len() / 9).max(1));
        let centre = |t: u32| mesh.corners(t as usize).iter().sum::<Vec3>() / 3.0;
        if component.iter().all(|t| closed.get(*t as usize).copied().unwrap_or(false)) {
            // A cavity is inside at all samples: components of a part may also overlap.
            let (mut within, mut n) = (0, 0);
            for t in samples {
                n += 1;
                within += usize::from(tree.odd(&centre(*t), |u| of(u) as usize != k));
            }
            if within == n {
                cavities.push(k);
                continue;
            }
            outer += 1;
            if volume(mesh, component.iter().copied()) < 0.0 {
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
            // In front of the surface and behind it: if the two do not differ, the mesh is not a solid there.
            let [before, behind] = [skin, -skin].map(|s| tree.odd(&(centre(*t) + normal * s), |_| true));
            inside += usize::from(before && !behind);
            outside += usize::from(!before && behind);
        }
        if inside > outside {
            out.push(k);
        }
    }
    // If all outer components are inside out, the cavities are too.
    if outer > 0 && out.len() == outer {
        out.extend(cavities);
    }
    out
}

/// Signed volume enclosed by some triangles; an open surface is closed by a cone to the centre of the mesh.
fn volume(mesh: &Mesh, of: impl IntoIterator<Item = u32>) -> f64 {
    let c = mesh.centre();
    of.into_iter()
        .map(|t| {
            let [p, q, r] = mesh.corners(t as usize).map(|v| v - c);
            p.dot(&q.cross(&r)) / 6.0
        })
        .sum()
}
