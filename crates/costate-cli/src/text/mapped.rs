//! What a run says of a map that was made to an error.

use super::counted;
use super::solved::Solved;
use costate::low_level::map::pieces::Region;
use costate::low_level::map::{ABOVE_BOUND, Adaptive, Agreement, Beyond, GROSS, Part};
use costate::low_level::model::MOST_MAP_STATES;
use costate::low_level::value::PointStatus;
use std::collections::BTreeMap;

/// A part of the region that is wider than this share of it along a variable is not told by that.
const ALL_ALONG: f64 = 0.7;

fn listed<'c>(counts: impl Iterator<Item = (&'c PointStatus, &'c usize)>) -> String {
    let each = counts.map(|(status, count)| format!("{count} {}", status.name()));
    each.collect::<Vec<String>>().join(", ")
}

/// Names of the map's variables: the states, and the time where it is an axis.
fn variables(done: &Solved<'_>, made: &Adaptive) -> Vec<String> {
    let time = (made.pieces.states() > done.names.len()).then(|| done.model.time_name().to_owned());
    done.names.iter().cloned().chain(time).collect()
}

/// Where nine tenths of a part of the region lie along each variable, if that tells something.
fn mostly(names: &[String], part: &Part, region: &Region) -> String {
    let each = names.iter().zip(&part.bounds).enumerate();
    let narrow: Vec<String> = each
        .filter(|(i, (_, [lo, hi]))| hi - lo < ALL_ALONG * region.width(*i))
        .map(|(_, (name, [lo, hi]))| {
            format!(
                "{name} from {} to {}",
                place(*lo, hi - lo),
                place(*hi, hi - lo)
            )
        })
        .collect();
    match narrow.is_empty() {
        true => String::new(),
        false => format!(", nine tenths of it with {}", narrow.join(", ")),
    }
}

/// Why nothing is known anywhere, if so.
fn nothing(made: &Adaptive) -> Option<&'static str> {
    if made.points > 0 {
        return None;
    }
    Some(match (made.failed, made.above_max) {
        (0, _) if made.first[0] == 0 && !made.is_searched() => {
            "none of its first states was solved in the time that there was: give more `seconds`"
        }
        (0, _) => {
            "guards exclude every state that was drawn in the map's region: move the region, or the guards"
        }
        (failed, above) if failed == above => {
            "V is above `value_max` at every state that was solved for: raise it, or leave it out"
        }
        _ => "no state that was tried has a solution: `costate solve` of one of them says more",
    })
}

/// A number with as many digits as tell ends of an interval so wide apart.
fn place(x: f64, width: f64) -> String {
    let decimals = 3.0 - width.abs().max(f64::MIN_POSITIVE).log10().floor();
    if decimals > 9.0 {
        return format!("{x:.5e}");
    }
    format!("{x:.*}", decimals.clamp(0.0, 9.0) as usize)
}

/// How many states were tried in vain, and why, in brackets.
fn failures(made: &Adaptive) -> String {
    let reasons = [
        (
            made.failed - made.above_max,
            "to which the ways tried led to no solution",
        ),
        (made.above_max, "of V above `value_max`"),
    ];
    let told: Vec<String> = reasons
        .iter()
        .filter(|(count, _)| *count > 0)
        .map(|(count, why)| format!("{count} more {why}"))
        .collect();
    match told.is_empty() {
        true => String::new(),
        false => format!(" ({})", told.join(", ")),
    }
}

pub fn text(done: &Solved<'_>, made: &Adaptive) -> Vec<String> {
    let mut lines = vec![format!(
        "{}: {} in {}, from {} along the trajectories of {}{}, {}, {:.1} s",
        of_what(done, made),
        counted(made.pieces.pieces.len(), "piece"),
        counted(made.pieces.cells.len(), "cell"),
        counted(made.points, "point"),
        counted(made.states, "state"),
        failures(made),
        counted(made.rounds, "round"),
        made.seconds
    )];
    if !made.is_searched() {
        lines.push(format!(
            "  the budget ended the first search after {} of its {} states, so a cheaper sheet may have been missed: give more `states` or \
             `seconds`",
            made.first[0], made.first[1]
        ));
    }
    lines.extend(nothing(made).map(|why| format!("  the map is empty: {why}")));
    lines.extend(of_error(done, made));
    if made.check.is_empty() {
        lines.extend(unchecked(made));
    } else {
        lines.extend(checked(done, made));
    }
    lines
}

/// Whether the error asked for is met, and where not.
fn of_error(done: &Solved<'_>, made: &Adaptive) -> Vec<String> {
    let region = &made.pieces.region;
    let asked = format!(
        "  error of V asked for {:.1e}, relative to max(V, {:.1e})",
        region.error, region.floor
    );
    let mut lines = Vec::new();
    if made.unmet.share > 0.0 {
        lines.push(format!(
            "{asked}: not met in {:.2} % of the region (by its own measure){}",
            100.0 * made.unmet.share,
            mostly(&variables(done, made), &made.unmet, region)
        ));
        if made.unknown.share > 0.0 {
            lines.push(of_unknown(done, made));
        }
        lines.push(match made.spent {
            true => "  the budget was spent: with more `states` or time the error is met in more of it".to_owned(),
            false => format!(
                "  more states would not help: cells with too many of those that were tried in vain are left{}",
                failures(made)
            ),
        });
    } else {
        lines.push(format!("{asked}: met by its own measure"));
    }
    lines
}

/// Where nothing is said of V, and why.
fn of_unknown(done: &Solved<'_>, made: &Adaptive) -> String {
    let why = match made.uncertain {
        0.0 => "as no points are there, or no answer exists".to_owned(),
        uncertain => format!(
            "in {:.2} % as the bound is above {:.1e} (`error_max`), elsewhere as no points are there, or no answer exists",
            100.0 * uncertain,
            made.error_max
        ),
    };
    let aim = done.model.map_aim.as_ref();
    let beside = match aim.is_some_and(|aim| aim.value_max.is_some()) {
        true => ", beside what may be above `value_max`",
        false => "",
    };
    format!(
        "  nothing is said in {:.2} % of the region{beside} ({why}){}",
        100.0 * made.unknown.share,
        mostly(&variables(done, made), &made.unknown, &made.pieces.region)
    )
}

/// Of a map without fresh states, where it was to have some.
fn unchecked(made: &Adaptive) -> Option<String> {
    (made.check_asked > 0).then(|| {
        "  no fresh state could be solved for in `seconds`: nothing checks what the map says"
            .to_owned()
    })
}

/// What fresh states show of the map, and of what lies beyond the region.
fn checked(done: &Solved<'_>, made: &Adaptive) -> Vec<String> {
    let shown = Agreement::new(&made.check, made.pieces.region.floor);
    let count = if made.check.len() < made.check_asked {
        format!(
            "{} of {} (`seconds` leaves no more time)",
            made.check.len(),
            made.check_asked
        )
    } else {
        made.check.len().to_string()
    };
    let others = match shown.unsolved.is_empty() {
        true => String::new(),
        false => format!(" ({})", listed(shown.unsolved.iter())),
    };
    let head = format!(
        "  check with {count} fresh states, never used in the map: {} solved{others}",
        shown.solved
    );
    if shown.known == 0 {
        return vec![format!("{head}, none of them known")];
    }
    let [median, most, worst] = shown.error;
    let mut lines = vec![format!(
        "{head}, of them {} known; relative error of V: median {median:.1e}, \
         99 % {most:.1e}, largest {worst:.1e}; error over its bound: 99 % {:.2}, largest {:.2}",
        shown.known, shown.over_bound[1], shown.over_bound[2]
    )];
    if shown.above_bound as f64 > ABOVE_BOUND * shown.known as f64 || shown.over_bound[2] > GROSS {
        lines.push(too_bold(&variables(done, made), &shown));
    }
    lines.extend(of_none(&shown.of_none));
    lines.extend(made.beyond.as_ref().map(|beyond| of_beyond(done, beyond)));
    lines
}

/// Of bounds that fresh states show to be too small; `names`: the map's variables.
fn too_bold(names: &[String], shown: &Agreement) -> String {
    let worst = shown.worst.as_ref().map_or(String::new(), |worst| {
        let at: Vec<String> = names
            .iter()
            .zip(&worst.x)
            .map(|(name, x)| format!("{name} = {x}"))
            .collect();
        format!(
            " (at {} it is {:.2e}, with a bound of {:.1e})",
            at.join(", "),
            (worst.said - worst.solved).abs(),
            worst.bound
        )
    });
    format!(
        "  WARNING: at {} of {} fresh states the error is above its bound{worst}: these bounds are not to be relied on; give more `states`",
        shown.above_bound, shown.known
    )
}

/// Fresh states for which no solution was found, and of which the map says V.
fn of_none(statuses: &BTreeMap<PointStatus, usize>) -> Vec<String> {
    // A search may fail where there is a solution; where one meets a guard or a fold there is none.
    let shows =
        |status: PointStatus| matches!(status, PointStatus::LeavesGuard | PointStatus::Fold);
    let some = |shown: bool| {
        let text = listed(
            statuses
                .iter()
                .filter(|(status, _)| shows(**status) == shown),
        );
        (!text.is_empty()).then_some(text)
    };
    let without = some(true).map(|these| {
        format!("  WARNING: at fresh states without an answer the map says one ({these})")
    });
    let missed = some(false).map(|these| {
        format!("  at fresh states for which the search found no solution the map says V ({these}): one of the two is wrong there")
    });
    without.into_iter().chain(missed).collect()
}

/// Where solutions leave the region, and what is known there.
fn of_beyond(done: &Solved<'_>, beyond: &Beyond) -> String {
    let region = &beyond.pieces.region;
    let bounds = done.names.iter().zip(region.lo.iter().zip(&region.hi));
    let bounds: Vec<String> = bounds
        .map(|(name, (lo, hi))| {
            format!("{name} {} to {}", place(*lo, hi - lo), place(*hi, hi - lo))
        })
        .collect();
    let mut line = format!(
        "  solutions leave the region: for laws {} pieces where they lead ({})",
        beyond.pieces.pieces.len(),
        bounds.join(", ")
    );
    let shown = Agreement::new(&beyond.check, region.floor);
    if shown.known > 0 {
        line += &format!(
            "; of {} points there on the fresh states' {:.1} % known, relative error of V: median {:.1e}, 99 % {:.1e}",
            shown.solved,
            100.0 * shown.known as f64 / shown.solved as f64,
            shown.error[0],
            shown.error[1]
        );
    }
    line
}

/// On a finite horizon whether the map is V(x, t), or why not.
fn of_what(done: &Solved<'_>, made: &Adaptive) -> String {
    let (Some(last), name) = (done.model.final_time(), done.model.time_name()) else {
        return "map".to_owned();
    };
    if made.pieces.states() > done.names.len() {
        return format!("map of V(x, {name}) for {name} from 0 to {last}");
    }
    let why = if done.model.is_game() {
        "a game's has no time axis"
    } else if done.names.len() >= MOST_MAP_STATES {
        "time counts as a state, and there are too many"
    } else {
        "[map] time = false"
    };
    format!("map of V at {name} = 0 alone ({why})")
}
