//! `costate merge`: the results of shards as one.

use crate::args::MergeArgs;
use crate::common::{Kind, check_out, print_json, provenance};
use crate::error::{CliError, ShardRefusal};
use crate::terminal::Terminal;
use crate::text;
use costate::run::{MergeOptions, merge as put_together};
use std::path::Path;

pub fn merge(args: &MergeArgs) -> Result<(), CliError> {
    let provenance = provenance();
    let inputs: Vec<&Path> = args.parts.iter().map(AsRef::as_ref).collect();
    check_out(Some(&args.out), &[Kind::Result], &inputs)?;
    let terminal = Terminal::new(args.print);
    let options = MergeOptions {
        partial: args.partial,
        stay: args.stay,
    };
    let merged = put_together(&args.parts, &args.out, options, &provenance, &terminal)?;
    terminal.say(&text::merged::merged(&merged))?;
    if args.print.json {
        let mut all = serde_json::to_value(&merged.summary).map_err(std::io::Error::other)?;
        all["shards_missing"] = serde_json::json!(merged.missing);
        all["shards_unfinished"] = serde_json::json!(merged.unfinished);
        print_json(&all)?;
    }
    match merged.missing.is_empty() && merged.unfinished.is_empty() {
        true => Ok(()),
        false => Err(ShardRefusal::Partial { path: merged.path }.into()),
    }
}
