//! Opening what is to be measured.

use super::variants::Missing;
use costate::backend::adapters::{self, AdapterInfo, Selection, adapters, no_adapter};
use costate::backend::cpu::Cpu;
use costate::backend::{Backend, BackendError};

/// A choice of backends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Which {
    /// What a run takes: a hardware GPU where there is one, else the CPU.
    Auto,
    Cpu,
    /// Every GPU adapter, software ones included.
    Gpu,
    /// The CPU and every GPU adapter; software adapters only where no hardware is.
    All,
}

/// Backends, and what cannot be had.
pub type Opened = (Vec<Box<dyn Backend>>, Vec<Missing>);

/// Opens backends, each once, and says what cannot be had. `adapter` restricts GPU adapters to one.
///
/// # Errors
/// When GPU adapters are asked for and there are none, or none of the name.
pub fn open(which: &[Which], adapter: Option<&str>) -> Result<Opened, BackendError> {
    let asked = |w| which.contains(&w);
    let mut backends: Vec<Box<dyn Backend>> = Vec::new();
    let mut missing = Vec::new();
    let hardware = asked(Which::Auto) && adapter.is_none() && adapters().iter().any(|a| a.hardware);
    if asked(Which::Cpu)
        || asked(Which::All)
        || (asked(Which::Auto) && adapter.is_none() && !hardware)
    {
        backends.push(Box::new(Cpu::new()));
    }
    if let Some(name) = adapter {
        backends.extend(adapters::open(&Selection::Named(name.to_owned()))?);
        return Ok((backends, missing));
    }
    if asked(Which::Gpu) || asked(Which::All) {
        let found = adapters();
        if found.is_empty() && asked(Which::Gpu) {
            return Err(no_adapter());
        }
        if found.is_empty() {
            missing.push(Missing {
                what: "gpu".into(),
                why: no_adapter().to_string(),
            });
        }
        let skip_software = !asked(Which::Gpu) && found.iter().any(|a| a.hardware);
        for (k, info) in found.iter().enumerate() {
            let before = found[..k].iter().find(|a| a.name == info.name);
            match open_one(info, before, skip_software) {
                Ok(gpu) => backends.push(gpu),
                Err(why) => missing.push(Missing {
                    what: format!("{} ({})", info.name, info.api),
                    why,
                }),
            }
        }
    } else if hardware {
        backends.extend(adapters::open(&Selection::Hardware)?);
    }
    Ok((backends, missing))
}

fn open_one(
    info: &AdapterInfo,
    before: Option<&AdapterInfo>,
    skip_software: bool,
) -> Result<Box<dyn Backend>, String> {
    if let Some(before) = before {
        return Err(format!(
            "a device of this name is measured through {}",
            before.api
        ));
    }
    if skip_software && !info.hardware {
        return Err("a software adapter, where there is hardware: name it with --adapter".into());
    }
    match adapters::open(&Selection::Named(info.name.clone())) {
        Ok(Some(gpu)) if gpu.adapter() == info.to_string() => Ok(gpu),
        Ok(_) => Err("another adapter answers to its name".into()),
        Err(e) => Err(e.to_string()),
    }
}

/// The machine in words: processor, threads, operating system.
pub fn machine() -> String {
    let processor = std::fs::read_to_string("/proc/cpuinfo")
        .ok()
        .and_then(|text| {
            let line = text.lines().find(|l| l.starts_with("model name"))?;
            line.split_once(':').map(|(_, name)| name.trim().to_owned())
        });
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    format!(
        "{}, {threads} threads, {} {}",
        processor.unwrap_or_else(|| "unnamed processor".into()),
        std::env::consts::OS,
        std::env::consts::ARCH
    )
}
