//! V at the solved states of a result file, to be compared with something else.

use crate::result::{Stored, StoredError};
use crate::trajectories::StatedErrors;
use crate::value::{Claims, Grid, PointStatus};

/// V at the solved states of `/points` and `/map`; empty where there are none.
///
/// # Errors
/// [`StoredError`] where the groups are not as this program writes them.
pub fn claims(stored: &Stored) -> Result<Claims, StoredError> {
    let mut claims = Claims::default();
    let mut add = |x: &[f64], v: f64, status: i32, error: Option<&StatedErrors>| {
        // A state from which a simulated control is cheaper has a V all the same.
        let solved = [PointStatus::Converged, PointStatus::Undercut];
        if v.is_finite() && solved.iter().any(|s| *s as i32 == status) {
            claims.x.extend_from_slice(x);
            claims.v.push(v);
            claims.error.push(error.map_or(0.0, |e| e.v.max(0.0)));
        }
    };
    let complete = |group: &str, status: &[i32], count: usize| match stored.group(group) {
        Some(group) if status.len() != count => {
            Err(group.error("status", "not as many as there are states"))
        }
        _ => Ok(()),
    };

    let n = stored.scene.model.states.len();
    if let Some(points) = stored.points()? {
        complete("points", &points.status, points.count)?;
        for (k, x) in points.x.chunks(n).enumerate() {
            add(x, points.v[k], points.status[k], points.errors.get(k));
        }
    }
    if let Some(map) = stored.map()? {
        complete("map", &map.status, map.v.len())?;
        let states = Grid { axes: map.axes }.points();
        for (k, x) in states.chunks(n).enumerate() {
            add(x, map.v[k], map.status[k], map.errors.get(k));
        }
    }
    Ok(claims)
}
