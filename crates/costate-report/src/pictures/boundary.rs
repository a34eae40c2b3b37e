//! The equal-cost boundary on a plane.
use crate::Source;
use costate::low_level::schema;

/// Polylines of `/equal_cost` on the plane of the two axes, where it is two-dimensional; single
/// points else.
#[derive(Clone, Debug, Default)]
pub struct Boundary {
    pub lines: Vec<Vec<[f64; 2]>>,
    pub points: Vec<[f64; 2]>,
}

impl Boundary {
    /// # Errors
    /// Where the group is not as this program writes it.
    pub fn read(source: &Source<'_>) -> Result<Self, String> {
        let mut boundary = Self::default();
        let n = source.model.states.len();
        let Some(group) = source.stored.group(&schema::EQUAL_COST).filter(|_| n >= 2) else {
            return Ok(boundary);
        };
        let text = |e: costate::low_level::result::StoredError| e.to_string();
        let x = group.f64("x").map_err(text)?.values;
        let line = group.i32("line").map_err(text)?.1;
        let [a, b] = source.axes;
        let mut last = None;
        for (x, line) in x.chunks(n).zip(line) {
            let on_plane = (0..n).filter(|k| *k != a && *k != b).all(|k| {
                let [from, to] = source.model.region[k];
                (x[k] - source.base[k]).abs() <= 1e-6 * (to - from)
            });
            if !on_plane {
                last = None;
                continue;
            }
            let at = [x[a], x[b]];
            if line < 0 {
                boundary.points.push(at);
            } else if last == Some(line) {
                if let Some(open) = boundary.lines.last_mut() {
                    open.push(at);
                }
            } else {
                boundary.lines.push(vec![at]);
            }
            last = Some(line).filter(|l| *l >= 0);
        }
        // A line of one vertex is a point.
        let (lines, single): (Vec<_>, Vec<_>) =
            boundary.lines.into_iter().partition(|l| l.len() > 1);
        boundary.points.extend(single.into_iter().flatten());
        boundary.lines = lines;
        Ok(boundary)
    }

    pub fn is_empty(&self) -> bool {
        self.lines.is_empty() && self.points.is_empty()
    }
}
