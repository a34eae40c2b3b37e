//! Which seeds of a sweep are neighbours.
//!
//! The triangulation that a sweep refines (`complex`) is known by its edges alone: where it is a flag
//! complex, what surrounds an edge are the vertices that are neighbours of both its ends. Splitting
//! an edge at a new vertex makes the new one a neighbour of the ends and of those around, and parts
//! the ends; the complex stays a flag complex (Lutz & Nevo 2016, on edge subdivisions). In six states
//! a seed has some 40 neighbours, but is a corner of hundreds of simplices.
//!
//! In a simplex of which two edges are split the order decides what its pieces are. It is a matter of
//! these edges alone: those of fewer halvings come first, then the wider gap. Edges that share no
//! simplex may be split in any order, with one result. So what a simplex of the first triangulation
//! becomes does not depend on the others, nor on what is integrated together: parts of the surface
//! can be swept apart, and have the same seeds where they meet.
//!
//! What is settled is forgotten: memory follows the unsettled part, not the number of seeds.

use super::parts::First;
use crate::numeric::random::random;
use rustc_hash::FxHashMap;
use std::collections::BTreeSet;

/// Index of a vertex, in order of creation.
pub type Vertex = u32;

/// An edge by its ends, the smaller index first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Edge(pub Vertex, pub Vertex);

impl Edge {
    pub fn new(a: Vertex, b: Vertex) -> Self {
        Edge(a.min(b), a.max(b))
    }
}

/// In a list so many times as long as the other each vertex is searched for.
const SEARCHED: usize = 8;

/// What has been found of an edge.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Found {
    /// An end has not been swept yet.
    Nothing,
    Settled,
    /// The gap between its ends asks for a seed.
    Apart(f32),
    /// It is to be split next.
    Chosen,
}

impl Found {
    fn is_open(self) -> bool {
        self != Found::Settled
    }
}

/// What an edge that may be split waits for.
#[derive(Clone, Debug, PartialEq)]
pub enum Waits {
    /// Nothing: it is its turn.
    No,
    /// Others, which wait for seeds too (with their gaps), and come first.
    For(Vec<(Edge, f32)>),
    /// What is found of edges that have come up since the last judgement, or will now.
    ForJudgement,
}

/// A neighbour.
#[derive(Clone, Copy, Debug)]
struct Link {
    to: Vertex,
    found: Found,
}

/// What is known of a vertex.
#[derive(Clone, Debug, Default)]
struct Star {
    /// In ascending order.
    neighbours: Vec<Link>,
    /// Edges here that are not settled.
    open: u32,
    /// Neighbours with such edges.
    open_neighbours: u32,
    /// The face of the first triangulation that it lies in.
    face: u32,
    /// Edges that were halved one after the other up to it.
    depth: u16,
    /// By which it is known whatever else is swept: numbers of vertices depend on it.
    name: u64,
}

/// Neighbourhoods with open (not yet settled) edges.
#[derive(Clone, Debug, Default)]
pub struct Neighbours {
    stars: Vec<Star>,
    faces: Faces,
    /// Edges that have come up since they were last asked for.
    fresh: Vec<Edge>,
    /// Vertices that nothing will be near, since they were last asked for.
    forgotten: Vec<Vertex>,
    /// Memory for what surrounds an edge.
    around: Vec<Vertex>,
}

impl Neighbours {
    /// Those of what is swept of a first triangulation, a flag complex.
    pub fn new(first: &First) -> Self {
        let mut this = Self {
            faces: Faces::new(first),
            ..Self::default()
        };
        for (face, number) in first.vertices.iter().enumerate() {
            this.stars.push(Star {
                face: face as u32,
                name: random(u64::from(*number), 0),
                ..Star::default()
            });
        }
        let mut edges: Vec<Edge> = (first.simplices.iter())
            .flat_map(|s| {
                let ends = |(i, a): (usize, &Vertex)| {
                    let a = *a;
                    s[i + 1..].iter().map(move |b| Edge::new(a, *b))
                };
                s.iter().enumerate().flat_map(ends)
            })
            .collect();
        edges.sort_unstable();
        edges.dedup();
        for Edge(a, b) in &edges {
            for (from, to) in [(*a, *b), (*b, *a)] {
                let star = &mut this.stars[from as usize];
                star.neighbours.push(Link {
                    to,
                    found: Found::Nothing,
                });
                star.open += 1;
                star.open_neighbours += 1;
            }
        }
        for star in &mut this.stars {
            star.neighbours.sort_unstable_by_key(|link| link.to);
        }
        this.fresh = edges;
        this
    }

    /// Edges that came up since the last call.
    pub fn take_fresh(&mut self) -> Vec<Edge> {
        std::mem::take(&mut self.fresh)
    }

    /// Vertices that no open edge is at or around any more, since the last call.
    pub fn take_forgotten(&mut self) -> Vec<Vertex> {
        std::mem::take(&mut self.forgotten)
    }

    /// The first simplex of the first triangulation that an edge lies in.
    pub fn root(&self, edge: Edge) -> u32 {
        self.faces.root(self.face(edge.0), self.face(edge.1))
    }

    /// The first simplex of the first triangulation that a vertex lies in.
    pub fn root_of(&self, vertex: Vertex) -> u32 {
        self.faces.first(self.face(vertex))
    }

    fn face(&self, vertex: Vertex) -> u32 {
        self.stars[vertex as usize].face
    }

    /// Edges that were halved one after the other up to a vertex.
    pub fn depth(&self, vertex: Vertex) -> u16 {
        self.stars[vertex as usize].depth
    }

    /// Halvings up to an edge.
    pub fn halvings(&self, edge: Edge) -> u16 {
        self.depth(edge.0).max(self.depth(edge.1))
    }

    /// The ends of an edge in an order that does not depend on what else is swept.
    pub fn ends(&self, edge: Edge) -> [Vertex; 2] {
        let name = |v: Vertex| self.stars[v as usize].name;
        match name(edge.0) <= name(edge.1) {
            true => [edge.0, edge.1],
            false => [edge.1, edge.0],
        }
    }

    /// What has been found of an edge; nothing of one that is split.
    pub fn found(&self, Edge(a, b): Edge) -> Option<Found> {
        let star = &self.stars[a as usize];
        star.find(b).map(|at| star.neighbours[at].found)
    }

    /// Where an edge is in the lists of its ends.
    pub fn places(&self, Edge(a, b): Edge) -> [u32; 2] {
        let place = |from: Vertex, to| self.stars[from as usize].find(to).unwrap_or(0) as u32;
        [place(a, b), place(b, a)]
    }

    /// Notes what has been found of an open edge.
    pub fn note(&mut self, edge: Edge, found: Found) {
        self.note_at(edge, self.places(edge), found);
    }

    /// The same, where places were looked up before: some of the lists may have lost others since.
    pub fn note_at(&mut self, Edge(a, b): Edge, places: [u32; 2], found: Found) {
        for ((from, to), place) in [(a, b), (b, a)].into_iter().zip(places) {
            let star = &mut self.stars[from as usize];
            let at = match star.neighbours.get(place as usize) {
                Some(link) if link.to == to => Some(place as usize),
                _ => star.find(to),
            };
            if let Some(at) = at {
                star.neighbours[at].found = found;
            }
        }
        if !found.is_open() {
            self.close(a);
            self.close(b);
        }
    }

    /// Marks an open edge as needing no seed between its ends.
    pub fn settle(&mut self, edge: Edge) {
        self.note(edge, Found::Settled);
    }

    /// What an edge with a gap waits for, of those it shares a simplex with; `around` is memory.
    pub fn waits(&self, edge: Edge, gap: f32, around: &mut Vec<Vertex>) -> Waits {
        let Edge(a, b) = edge;
        self.around(edge, around);
        let depth = self.halvings(edge);
        let mut first: Vec<(Edge, f32)> = Vec::new();
        let mut fewest = depth;
        let mut look = |from: Vertex, link: &Link| {
            let other = Edge::new(from, link.to);
            let halvings = self.halvings(other);
            match link.found {
                Found::Nothing => return halvings > depth,
                // What comes of it has as few halvings, or fewer.
                Found::Chosen => return halvings >= depth,
                Found::Settled => {}
                Found::Apart(width) => {
                    let wider = || gap.total_cmp(&width);
                    let named = || self.names(other).cmp(&self.names(edge));
                    let order = halvings.cmp(&depth).then_with(wider).then_with(named);
                    if halvings <= fewest && order.then(other.cmp(&edge)).is_lt() {
                        // Beside these the others do not matter yet.
                        if halvings < fewest {
                            fewest = halvings;
                            first.clear();
                        }
                        first.push((other, width));
                    }
                }
            }
            true
        };
        // Those at its ends, and those among what surrounds it.
        for (k, from) in [a, b].iter().chain(around.iter()).enumerate() {
            let others = &around[k.saturating_sub(1).min(around.len())..];
            let links = &self.stars[*from as usize].neighbours;
            let unsettled = |link: &Link| link.found != Found::Settled;
            if !shared(links, others, |link| !unsettled(link) || look(*from, link)) {
                return Waits::ForJudgement;
            }
        }
        match first.is_empty() {
            true => Waits::No,
            false => Waits::For(first),
        }
    }

    fn names(&self, edge: Edge) -> [u64; 2] {
        self.ends(edge).map(|v| self.stars[v as usize].name)
    }

    /// One open edge less at a vertex.
    fn close(&mut self, vertex: Vertex) {
        let star = &mut self.stars[vertex as usize];
        star.open -= 1;
        if star.open > 0 {
            return;
        }
        let mut done = std::mem::take(&mut self.around);
        done.clear();
        if self.stars[vertex as usize].open_neighbours == 0 {
            done.push(vertex);
        }
        for k in 0..self.stars[vertex as usize].neighbours.len() {
            let v = self.stars[vertex as usize].neighbours[k].to;
            let other = &mut self.stars[v as usize];
            other.open_neighbours -= 1;
            if other.open_neighbours == 0 && other.open == 0 {
                done.push(v);
            }
        }
        for v in &done {
            self.forget(*v);
        }
        self.around = done;
    }

    /// Drops a vertex that no open edge is at or around.
    fn forget(&mut self, vertex: Vertex) {
        for link in std::mem::take(&mut self.stars[vertex as usize].neighbours) {
            let star = &mut self.stars[link.to as usize];
            if let Some(at) = star.find(vertex) {
                star.neighbours.remove(at);
            }
        }
        self.forgotten.push(vertex);
    }

    /// Puts the common neighbours of an edge's ends into a list.
    pub fn around(&self, Edge(a, b): Edge, to: &mut Vec<Vertex>) {
        to.clear();
        let of = |v: Vertex| &self.stars[v as usize].neighbours;
        common(of(a), of(b), to);
    }

    /// Whether a vertex lies in the face of the first triangulation that an edge lies in: whatever
    /// else is swept, it is there.
    pub fn is_beside(&self, vertex: Vertex, edge: Edge) -> bool {
        let (a, b) = (self.face(edge.0), self.face(edge.1));
        self.faces.have(self.face(vertex), a, b)
    }

    /// Splits an open edge at a new vertex. What is near both ends is near what is between them: it
    /// is not compared with that.
    pub fn split(&mut self, edge: Edge) -> Vertex {
        let Edge(a, b) = edge;
        let middle = self.stars.len() as Vertex;
        let mut around = std::mem::take(&mut self.around);
        self.around(edge, &mut around);
        let link = |to: Vertex, near: bool| Link {
            to,
            found: if near { Found::Settled } else { Found::Nothing },
        };
        // (Later edges may be settled by now or not.)
        let depth = self.halvings(edge);
        let is_near = |c: Vertex| {
            let settled = |from: Vertex| {
                let star = &self.stars[from as usize];
                let at = star.find(c);
                at.is_some_and(|at| star.neighbours[at].found == Found::Settled)
            };
            self.depth(c) <= depth && settled(a) && settled(b)
        };
        let mut links: Vec<Link> = around.iter().map(|c| link(*c, is_near(*c))).collect();

        // Each end has the new vertex as a neighbour in the other's place: as many open ones.
        for (from, to) in [(a, b), (b, a)] {
            let star = &mut self.stars[from as usize];
            if let Some(at) = star.find(to) {
                star.neighbours.remove(at);
            }
            star.neighbours.push(link(middle, false));
        }
        for Link { to: c, found } in &links {
            let open = u32::from(found.is_open());
            if open > 0 && self.stars[*c as usize].open == 0 {
                self.reopen(*c);
            }
            let star = &mut self.stars[*c as usize];
            star.open += open;
            star.open_neighbours += 1;
            star.neighbours.push(Link {
                to: middle,
                found: *found,
            });
        }

        links.extend([link(a, false), link(b, false)]);
        links.sort_unstable_by_key(|link| link.to);
        let open = || links.iter().filter(|link| link.found.is_open());
        (self.fresh).extend(open().map(|link| Edge(link.to, middle)));
        let [first, second] = self.names(edge);
        let is_open = |link: &&Link| self.stars[link.to as usize].open > 0;
        self.stars.push(Star {
            open: open().count() as u32,
            open_neighbours: links.iter().filter(is_open).count() as u32,
            face: self.faces.join(self.face(a), self.face(b)),
            depth: self.halvings(edge).saturating_add(1),
            name: random(first, second),
            neighbours: links,
        });
        self.around = around;
        middle
    }

    /// Tells its neighbours that a vertex will have an open edge again.
    fn reopen(&mut self, vertex: Vertex) {
        for k in 0..self.stars[vertex as usize].neighbours.len() {
            let v = self.stars[vertex as usize].neighbours[k].to;
            self.stars[v as usize].open_neighbours += 1;
        }
    }
}

impl Star {
    /// Where a neighbour is in the list.
    fn find(&self, vertex: Vertex) -> Option<usize> {
        (self.neighbours)
            .binary_search_by_key(&vertex, |link| link.to)
            .ok()
    }
}

/// The vertices in both of two ascending lists.
fn common(a: &[Link], b: &[Link], to: &mut Vec<Vertex>) {
    let (few, many) = if a.len() < b.len() { (a, b) } else { (b, a) };
    if few.len() * SEARCHED < many.len() {
        let is_there = |v: &Vertex| many.binary_search_by_key(v, |link| link.to).is_ok();
        to.extend(few.iter().map(|link| link.to).filter(is_there));
        return;
    }
    let (mut i, mut j) = (0, 0);
    while i < few.len() && j < many.len() {
        let (x, y) = (few[i].to, many[j].to);
        if x == y {
            to.push(x);
        }
        i += usize::from(x <= y);
        j += usize::from(y <= x);
    }
}

/// Looks at the links to some vertices, in ascending order, until it is told to stop; whether it was
/// not.
fn shared(links: &[Link], with: &[Vertex], mut look: impl FnMut(&Link) -> bool) -> bool {
    if with.len() * SEARCHED < links.len() {
        return with.iter().all(|v| {
            let at = links.binary_search_by_key(v, |link| link.to);
            at.map_or(true, |at| look(&links[at]))
        });
    }
    let mut rest = with;
    for link in links {
        while rest.first().is_some_and(|v| *v < link.to) {
            rest = &rest[1..];
        }
        match rest.first() {
            None => return true,
            Some(v) if *v == link.to && !look(link) => return false,
            Some(_) => {}
        }
    }
    true
}

/// Faces of the first triangulation, each by the simplices that have it.
#[derive(Clone, Debug, Default)]
struct Faces {
    /// By face, in ascending order; those of the vertices first.
    simplices: Vec<Vec<u32>>,
    joins: FxHashMap<(u32, u32), u32>,
}

impl Faces {
    fn new(first: &First) -> Self {
        Self {
            simplices: first.roots.clone(),
            joins: FxHashMap::default(),
        }
    }

    /// The simplices that have both of two faces, in ascending order.
    fn of_both(&self, a: u32, b: u32) -> impl Iterator<Item = u32> {
        let (a, mut b) = (&self.simplices[a as usize], &self.simplices[b as usize][..]);
        a.iter().copied().filter(move |x| {
            while b.first().is_some_and(|y| y < x) {
                b = &b[1..];
            }
            b.first() == Some(x)
        })
    }

    /// The first simplex that has a face.
    fn first(&self, face: u32) -> u32 {
        self.simplices[face as usize].first().copied().unwrap_or(0)
    }

    /// The first simplex that has both of two faces.
    fn root(&self, a: u32, b: u32) -> u32 {
        self.of_both(a, b).next().unwrap_or(0)
    }

    /// Whether a face lies in the smallest one that two others lie in.
    fn have(&self, face: u32, a: u32, b: u32) -> bool {
        let mut of = &self.simplices[face as usize][..];
        self.of_both(a, b).all(|root| {
            while of.first().is_some_and(|other| *other < root) {
                of = &of[1..];
            }
            of.first() == Some(&root)
        })
    }

    /// The smallest face that two faces lie in.
    fn join(&mut self, a: u32, b: u32) -> u32 {
        if a == b {
            return a;
        }
        let key = (a.min(b), a.max(b));
        if let Some(face) = self.joins.get(&key) {
            return *face;
        }
        let both: Vec<u32> = self.of_both(a, b).collect();
        let face = if both == self.simplices[a as usize] {
            a
        } else if both == self.simplices[b as usize] {
            b
        } else {
            self.simplices.push(both);
            self.simplices.len() as u32 - 1
        };
        self.joins.insert(key, face);
        face
    }
}

/// An edge that waits, with the gap between its ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Wait {
    /// Up to it.
    halvings: u16,
    /// The gap's bits, falling: gaps are positive, and their bits order as their values.
    falling: u32,
    edge: Edge,
}

impl Wait {
    fn new(halvings: u16, gap: f32, edge: Edge) -> Self {
        Self {
            halvings,
            falling: u32::MAX - gap.to_bits(),
            edge,
        }
    }

    fn gap(&self) -> f32 {
        f32::from_bits(u32::MAX - self.falling)
    }

    fn turn(&self) -> (u32, u32, Edge) {
        // The exponent is the octave.
        let octave = self.falling >> (f32::MANTISSA_DIGITS - 1);
        (octave + u32::from(self.halvings), self.falling, self.edge)
    }
}

impl Ord for Wait {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.turn().cmp(&other.turn())
    }
}

impl PartialOrd for Wait {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

/// Edges waiting for a seed, in the order in which they get one: the widest gaps first, so that a cap
/// on seeds leaves no part of a front far behind; but of twice the width for each halving, for those
/// of fewer halvings come first in their simplices anyway.
#[derive(Clone, Debug, Default)]
pub struct Waiting(BTreeSet<Wait>);

impl Waiting {
    pub fn push(&mut self, halvings: u16, gap: f32, edge: Edge) {
        self.0.insert(Wait::new(halvings, gap, edge));
    }

    pub fn pop(&mut self) -> Option<(Edge, f32)> {
        self.0.pop_first().map(|w| (w.edge, w.gap()))
    }

    /// Takes one out of its turn.
    pub fn take(&mut self, halvings: u16, gap: f32, edge: Edge) {
        self.0.remove(&Wait::new(halvings, gap, edge));
    }

    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// The edges with their gaps, in order.
    pub fn iter(&self) -> impl Iterator<Item = (Edge, f32)> {
        self.0.iter().map(|w| (w.edge, w.gap()))
    }

    /// Leaves so many, the first in order, and gives the others with their gaps.
    pub fn keep(&mut self, count: usize) -> Vec<(Edge, f32)> {
        let Some(first) = self.0.iter().nth(count).copied() else {
            return Vec::new();
        };
        let dropped = self.0.split_off(&first);
        dropped.iter().map(|w| (w.edge, w.gap())).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::numeric::random::random;
    use crate::sweep::complex::Complex;
    use crate::sweep::parts::SurfacePart;
    use std::collections::BTreeSet;

    /// The whole of a triangulation.
    fn all(complex: &Complex) -> First {
        let parameters = vec![Vec::new(); complex.vertices()];
        First::new(&complex.simplices(), &parameters, SurfacePart::WHOLE)
    }

    /// Whatever is split, and whatever is settled and forgotten meanwhile, the neighbours are those
    /// of the simplicial complex, with its roots.
    #[test]
    fn neighbours_are_those_of_the_complex() {
        for (n, splits) in [(1, 0), (2, 200), (3, 200), (4, 150), (5, 80), (6, 60)] {
            let complexes = [Complex::sphere(n), Complex::unit_box(n.min(4))];
            for (kind, (mut complex, _)) in complexes.into_iter().enumerate() {
                complex.take_fresh();
                let first = complex.simplices();
                let mut neighbours = Neighbours::new(&all(&complex));
                let mut roots: Vec<BTreeSet<u32>> = vec![BTreeSet::new(); complex.vertices()];
                for (root, simplex) in first.iter().enumerate() {
                    for v in simplex {
                        roots[*v as usize].insert(root as u32);
                    }
                }
                let mut open = neighbours.take_fresh();
                let mut forgotten = BTreeSet::new();
                for step in 0..splits {
                    if open.is_empty() {
                        break;
                    }
                    let draw = random((n + 10 * kind) as u64, step) as usize;
                    let edge = open.swap_remove(draw % open.len());
                    if step % 3 == 2 {
                        neighbours.settle(edge);
                    } else {
                        assert_eq!(neighbours.split(edge), complex.split(edge));
                        let both = &roots[edge.0 as usize] & &roots[edge.1 as usize];
                        roots.push(both);
                    }
                    open.extend(neighbours.take_fresh());
                    forgotten.extend(neighbours.take_forgotten());
                    compare(&neighbours, &complex, &open, &forgotten);
                    for edge in &open {
                        let mut both = roots[edge.0 as usize].intersection(&roots[edge.1 as usize]);
                        assert_eq!(Some(&neighbours.root(*edge)), both.next());
                    }
                }
                // At last nothing is left.
                for edge in open {
                    neighbours.settle(edge);
                }
                forgotten.extend(neighbours.take_forgotten());
                let alone = if n == 1 && kind == 0 { 2 } else { 0 };
                assert_eq!(forgotten.len() + alone, neighbours.stars.len());
            }
        }
    }

    /// Refines a part of a sphere until its edges are as short as a density of seeds asks, looking at
    /// the edges in an order by chance; the seeds, and how often edges waited for others.
    fn refined(n: usize, part: SurfacePart, chance: u64) -> (BTreeSet<Vec<u64>>, usize) {
        let (complex, directions) = Complex::sphere(n);
        let first = First::new(&complex.simplices(), &directions, part);
        let mut at: Vec<Vec<f64>> = (first.vertices.iter())
            .map(|v| directions[*v as usize].clone())
            .collect();
        let mut neighbours = Neighbours::new(&first);
        let mut apart: Vec<(Edge, f32)> = Vec::new();
        let (mut draw, mut waited) = (0, 0);
        let mut around = Vec::new();
        loop {
            for edge in neighbours.take_fresh() {
                let ends = [&at[edge.0 as usize], &at[edge.1 as usize]];
                let square: f64 = (0..n).map(|k| (ends[0][k] - ends[1][k]).powi(2)).sum();
                // Denser toward a corner of the sphere.
                let dense = 1.0 + ends[0][0].max(ends[1][0]).max(0.0);
                let gap = (square.sqrt() * dense) as f32;
                if gap > 0.8 {
                    neighbours.note(edge, Found::Apart(gap));
                    apart.push((edge, gap));
                } else {
                    neighbours.settle(edge);
                }
            }
            if apart.is_empty() {
                break;
            }
            draw += 1;
            let next = random(chance, draw) as usize % apart.len();
            let (edge, gap) = apart[next];
            if neighbours.waits(edge, gap, &mut around) != Waits::No {
                waited += 1;
                continue;
            }
            apart.swap_remove(next);
            let [a, b] = neighbours.ends(edge).map(|v| at[v as usize].clone());
            at.push(a.iter().zip(&b).map(|(a, b)| a + 0.5 * (b - a)).collect());
            neighbours.split(edge);
        }
        let bits = |v: &Vec<f64>| v.iter().map(|x| x.to_bits()).collect();
        (at.iter().map(bits).collect(), waited)
    }

    /// Seeds do not depend on the order in which edges are looked at, nor on what else of the surface
    /// is swept: those of parts are those of the whole.
    #[test]
    fn parts_have_the_seeds_of_the_whole() {
        for n in [2, 3, 4, 5] {
            let (whole, waited) = refined(n, SurfacePart::WHOLE, 1);
            assert!(whole.len() > 4 * n, "{}", whole.len());
            assert!(n == 2 || waited > 0);
            for chance in 2..5 {
                assert_eq!(refined(n, SurfacePart::WHOLE, chance).0, whole);
            }
            for parts in [2, 3, 5] {
                let (mut union, mut swept) = (BTreeSet::new(), 0);
                for part in 0..parts {
                    let part = SurfacePart { part, parts };
                    let (seeds, _) = refined(n, part, 7);
                    swept += seeds.len();
                    union.extend(seeds);
                }
                assert_eq!(union, whole, "{n} states, {parts} parts");
                assert!(swept < parts * whole.len());
            }
        }
    }

    /// Edges that are split together are all of a turn: of those that share a simplex the ones of
    /// fewer halvings come first, then the wider ones, and what is not judged yet is waited for.
    #[test]
    fn edges_of_a_simplex_have_their_turns() {
        let simplex = vec![vec![0, 1, 2]];
        let first = First::new(&simplex, &vec![Vec::new(); 3], SurfacePart::WHOLE);
        let mut neighbours = Neighbours::new(&first);
        let mut around = Vec::new();
        let mut waits = |neighbours: &Neighbours, a, b, gap| {
            neighbours.waits(Edge::new(a, b), gap, &mut around)
        };
        neighbours.take_fresh();
        neighbours.note(Edge(0, 1), Found::Apart(1.0));
        neighbours.note(Edge(1, 2), Found::Apart(2.0));
        assert_eq!(waits(&neighbours, 1, 2, 2.0), Waits::ForJudgement);
        neighbours.settle(Edge(0, 2));
        assert_eq!(waits(&neighbours, 1, 2, 2.0), Waits::No);
        let first = Waits::For(vec![(Edge(1, 2), 2.0)]);
        assert_eq!(waits(&neighbours, 0, 1, 1.0), first);
        // With the same halvings both can be split at once, in this order.
        neighbours.note(Edge(1, 2), Found::Chosen);
        assert_eq!(waits(&neighbours, 0, 1, 1.0), Waits::No);
        // What comes of the first waits for the second, however wide.
        assert_eq!(neighbours.split(Edge(1, 2)), 3);
        neighbours.take_fresh();
        for edge in [Edge(0, 3), Edge(1, 3), Edge(2, 3)] {
            neighbours.note(edge, Found::Apart(9.0));
        }
        assert_eq!(waits(&neighbours, 0, 1, 1.0), Waits::No);
        let first = Waits::For(vec![(Edge(0, 1), 1.0)]);
        assert_eq!(waits(&neighbours, 0, 3, 9.0), first);
    }

    fn compare(
        neighbours: &Neighbours,
        complex: &Complex,
        open: &[Edge],
        forgotten: &BTreeSet<Vertex>,
    ) {
        let mut expected: BTreeSet<Edge> = BTreeSet::new();
        for simplex in complex.simplices() {
            for (i, a) in simplex.iter().enumerate() {
                expected.extend(simplex[i + 1..].iter().map(|b| Edge::new(*a, *b)));
            }
        }
        expected.retain(|e| !forgotten.contains(&e.0) && !forgotten.contains(&e.1));
        let mut found = BTreeSet::new();
        for (v, star) in neighbours.stars.iter().enumerate() {
            let v = v as Vertex;
            assert!(star.neighbours.is_sorted_by_key(|link| link.to));
            let here = open.iter().filter(|e| e.0 == v || e.1 == v);
            assert_eq!(here.count() as u32, star.open);
            let open = |link: &&Link| neighbours.stars[link.to as usize].open > 0;
            let count = star.neighbours.iter().filter(open).count() as u32;
            assert_eq!(count, star.open_neighbours);
            if !forgotten.contains(&v) {
                assert!(star.open + star.open_neighbours > 0);
            }
            found.extend(star.neighbours.iter().map(|link| Edge::new(v, link.to)));
        }
        assert_eq!(found, expected);
    }

    /// The widest come first, to a factor of two for each halving, and those left out are the last.
    #[test]
    fn edges_wait_in_order() {
        let gaps = [0.3f32, 1.7, 0.26, 1.1, 0.9, 0.01];
        let waiting = || {
            let mut waiting = Waiting::default();
            for (k, gap) in gaps.iter().enumerate() {
                let k = k as u32;
                let halvings = if k == 1 { 3 } else { 0 };
                waiting.push(halvings, *gap, Edge(k, k + 1));
            }
            waiting
        };
        let order = |mut waiting: Waiting| -> Vec<u32> {
            std::iter::from_fn(|| waiting.pop())
                .map(|(edge, gap)| {
                    assert_eq!(gap, gaps[edge.0 as usize]);
                    edge.0
                })
                .collect()
        };
        assert_eq!(order(waiting()), [3, 4, 0, 2, 1, 5]);
        let mut fewer = waiting();
        let mut dropped: Vec<u32> = fewer.keep(4).iter().map(|(edge, _)| edge.0).collect();
        dropped.sort_unstable();
        assert_eq!(dropped, [1, 5]);
        assert_eq!(order(fewer), [3, 4, 0, 2]);
    }
}
