//! Which part of the work a process does.

use crate::args::{ShardArgs, ShardChoice};
use crate::error::ShardRefusal;
use crate::terminal::Terminal;
use costate::run::of_shard;
use costate::session::{Progress, Resume, Shard};
use std::env::VarError;

/// What Slurm tells the tasks of a job array.
const ID: &str = "SLURM_ARRAY_TASK_ID";
const COUNT: &str = "SLURM_ARRAY_TASK_COUNT";
const MIN: &str = "SLURM_ARRAY_TASK_MIN";
const STEP: &str = "SLURM_ARRAY_TASK_STEP";

/// The shard asked for; without one that of a job array's task, which is said. `None` for all of the
/// work.
///
/// # Errors
/// Where the environment does not tell which one that is.
pub fn of(args: ShardArgs, terminal: &Terminal) -> Result<Option<Shard>, ShardRefusal> {
    match args.shard {
        Some(ShardChoice::All) => Ok(None),
        Some(ShardChoice::One(shard)) => Ok(Some(shard)),
        None => {
            let shard = of_array(&|name| std::env::var(name))?;
            if let Some(shard) = shard {
                terminal.note(&format!(
                    "shard {shard}, by {ID} (--shard none does all of the work)"
                ));
            }
            Ok(shard)
        }
    }
}

/// What the name of its result ends in, where the user gives none.
pub fn ending(shard: Option<Shard>) -> String {
    shard.map_or_else(String::new, |shard| of_shard(shard.number(), shard.of()))
}

/// Whether what is done is kept, and what was done before is used.
pub fn resume(args: ShardArgs) -> Resume {
    match args.resume {
        true => Resume::Now(args.checkpoint),
        false => Resume::Later(args.checkpoint),
    }
}

/// The shard of a job array's task; `None` outside of one.
fn of_array(
    variable: &dyn Fn(&'static str) -> Result<String, VarError>,
) -> Result<Option<Shard>, ShardRefusal> {
    let number = |name: &'static str| match variable(name) {
        Err(VarError::NotPresent) => Ok(None),
        Err(VarError::NotUnicode(text)) => Err(ShardRefusal::NoNumber {
            name,
            text: text.to_string_lossy().into_owned(),
        }),
        Ok(text) => match text.trim().parse::<usize>() {
            Ok(number) => Ok(Some(number)),
            Err(_) => Err(ShardRefusal::NoNumber { name, text }),
        },
    };
    let (id, of) = match (number(ID)?, number(COUNT)?) {
        (None, None) => return Ok(None),
        (Some(_), None) => return Err(ShardRefusal::Half { is: ID, not: COUNT }),
        (None, Some(_)) => return Err(ShardRefusal::Half { is: COUNT, not: ID }),
        (Some(id), Some(of)) => (id, of),
    };
    // (Slurm tells the first one; counted from another number the last task would be refused.)
    let (min, step) = (number(MIN)?.unwrap_or(0), number(STEP)?.unwrap_or(1));
    let refused = ShardRefusal::NotInTurn { id, of, min, step };
    let place = id
        .checked_sub(min)
        .filter(|place| step > 0 && place.is_multiple_of(step));
    let shard = place.and_then(|place| Shard::new(place / step, of).ok());
    shard.map(Some).ok_or(refused)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of_variables(given: &[(&str, &str)]) -> Result<Option<Shard>, ShardRefusal> {
        of_array(&|name| {
            let found = given.iter().find(|(own, _)| *own == name);
            found
                .map(|(_, text)| (*text).to_owned())
                .ok_or(VarError::NotPresent)
        })
    }

    #[test]
    fn a_task_of_an_array_has_its_shard() {
        let shard = |m, n| Some(Shard::new(m, n).unwrap());
        let all = |id, count, min| of_variables(&[(ID, id), (COUNT, count), (MIN, min)]);
        assert_eq!(of_variables(&[]).unwrap(), None);
        assert_eq!(all("0", "16", "0").unwrap(), shard(0, 16));
        assert_eq!(all("16", "16", "1").unwrap(), shard(15, 16));
        assert_eq!(
            of_variables(&[(ID, "3"), (COUNT, "4")]).unwrap(),
            shard(3, 4)
        );
        assert!(of_variables(&[(ID, "4"), (COUNT, "4")]).is_err());
        let steps = [(ID, "14"), (COUNT, "8"), (MIN, "0"), (STEP, "2")];
        assert_eq!(of_variables(&steps).unwrap(), shard(7, 8));
    }

    #[test]
    fn what_does_not_tell_the_shard_is_refused() {
        // One of the two alone, a number that is none, and a part of an array alone.
        let half = of_variables(&[(ID, "3")]).unwrap_err();
        assert!(half.to_string().contains(COUNT), "{half}");
        let half = of_variables(&[(COUNT, "3"), (MIN, "0")]).unwrap_err();
        assert!(half.to_string().contains(ID), "{half}");
        for id in ["", "x", "-1", "1.5"] {
            assert!(of_variables(&[(ID, id), (COUNT, "4"), (MIN, "0")]).is_err());
        }
        let apart = [(ID, "7"), (COUNT, "2"), (MIN, "3"), (STEP, "1")];
        let refused = of_variables(&apart).unwrap_err();
        assert!(refused.to_string().contains("--shard"), "{refused}");
        assert!(of_variables(&[(ID, "0"), (COUNT, "4"), (MIN, "1")]).is_err());
        assert!(of_variables(&[(ID, "0"), (COUNT, "0"), (MIN, "0")]).is_err());
    }
}
