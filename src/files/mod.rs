//! Files on disk: there under their final name only when they are complete.

mod behind;
mod error;
mod temporary;
#[cfg(test)]
pub(crate) mod testing;

pub use behind::Behind;
pub use error::FileError;
pub use temporary::Temporary;
#[cfg(unix)]
pub use temporary::{heed_input, removed_at_signals, stop_at_signals};

use std::ffi::{OsStr, OsString};
use std::fs::{self, File};
use std::io::{self, ErrorKind, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// Tells apart the temporary files of one process.
static TEMPORARIES: AtomicU64 = AtomicU64::new(0);

/// A file being written under a hidden name beside its final one. Dropped before [`Draft::publish`]
/// it leaves nothing, and an older file under the final name stays as it is.
#[derive(Debug)]
pub struct Draft {
    path: PathBuf,
    temporary: Temporary,
}

/// Those who may have put a file of theirs under a name that was free.
pub struct Others {
    /// Where one's own goes then.
    pub beside: PathBuf,
    /// Whether a file is theirs.
    pub are_there: Box<dyn Fn(&Path) -> bool + Send>,
}

impl Draft {
    /// Claims the hidden name for the file that will be `path`; missing parent directories are
    /// made, and go again with what is not published. The caller makes the file.
    ///
    /// # Errors
    /// Those of [`target`], and [`FileError::CreateDirectory`].
    pub fn begin(path: &Path) -> Result<Self, FileError> {
        let path = target(path)?;
        let directory = directory_of(&path);
        let made = (directory.ancestors())
            .take_while(|d| !d.as_os_str().is_empty() && !d.exists())
            .map(Path::to_owned)
            .collect();
        make(directory)?;
        let name = path.file_name().unwrap_or_default();
        clear_leftovers(directory, name);
        let temporary = Temporary::within(hidden_name(directory, name), made);
        Ok(Self { path, temporary })
    }

    /// The name the file will have.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Chooses another name for it, in the same directory.
    pub fn rename(&mut self, path: PathBuf) {
        self.path = path;
    }

    /// The hidden name it has now.
    pub fn hidden(&self) -> &Path {
        self.temporary.path()
    }

    /// As [`publish`](Self::publish), but in place of what others have put there meanwhile nothing
    /// comes: the file is then beside it.
    ///
    /// # Errors
    /// As [`publish`](Self::publish).
    pub fn publish_beside(mut self, others: &Others) -> Result<PathBuf, FileError> {
        loop {
            match self.temporary.link(&self.path) {
                Ok(()) => {
                    let _ = sync_directory(directory_of(&self.path));
                    return Ok(self.path.clone());
                }
                Err(error)
                    if error.kind() == ErrorKind::AlreadyExists
                        && self.path != others.beside
                        && (others.are_there)(&self.path) =>
                {
                    self.path.clone_from(&others.beside);
                }
                Err(_) => return self.publish(),
            }
        }
    }

    /// Gives the complete file its final name, replacing what was there; returns that name.
    ///
    /// # Errors
    /// [`FileError::Rename`]; the file is then gone, and an older one is still there.
    pub fn publish(self) -> Result<PathBuf, FileError> {
        let Self { path, temporary } = self;
        temporary
            .publish(&path)
            .map_err(|source| FileError::Rename {
                path: path.clone(),
                source,
            })?;
        // The file is complete and in place; some network file systems refuse to flush a directory.
        let _ = sync_directory(directory_of(&path));
        Ok(path)
    }
}

/// The file that a path names: of a link the one that it leads to.
///
/// # Errors
/// [`FileError::NoFileName`], [`FileError::TargetIsDirectory`] and [`FileError::TargetIsSpecial`]:
/// nothing but a regular file is replaced; [`FileError::CreateDirectory`] where a file stands in
/// place of one of its directories.
pub fn target(given: &Path) -> Result<PathBuf, FileError> {
    let linked = given
        .is_symlink()
        .then(|| fs::canonicalize(given).ok())
        .flatten();
    let path = linked.unwrap_or_else(|| given.to_owned());
    if path.file_name().is_none() {
        return Err(FileError::NoFileName { path });
    }
    if path.is_dir() {
        return Err(FileError::TargetIsDirectory { path });
    }
    if path.exists() && !path.is_file() {
        return Err(FileError::TargetIsSpecial { path });
    }
    let directory = directory_of(&path);
    let nearest = directory.ancestors().find(|d| d.exists());
    if nearest.is_some_and(|d| !d.is_dir()) {
        return Err(FileError::CreateDirectory {
            directory: directory.to_owned(),
            source: io::ErrorKind::NotADirectory.into(),
        });
    }
    Ok(path)
}

/// The most that is read of a text: no scene, table of points or weights is longer.
const MOST_READ: u64 = 256 << 20;
/// How files of that kind begin.
const HDF5: &[u8] = b"\x89HDF\r\n\x1a\n";

/// The bytes of a file, of at most 256 MiB: what has no end is not read until memory is full.
///
/// # Errors
/// Those of reading; a longer file.
pub fn read_bytes(path: &Path) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    File::open(path)?
        .take(MOST_READ + 1)
        .read_to_end(&mut bytes)?;
    if bytes.len() as u64 > MOST_READ {
        let reason = format!("more than {} MiB, which no such file has", MOST_READ >> 20);
        return Err(io::Error::new(io::ErrorKind::InvalidData, reason));
    }
    Ok(bytes)
}

/// Whether bytes are those of an HDF5 file, which result files are.
pub fn is_hdf5(bytes: &[u8]) -> bool {
    bytes.starts_with(HDF5)
}

/// The first few bytes of a file.
///
/// # Errors
/// Those of reading.
pub fn beginning(path: &Path) -> io::Result<Vec<u8>> {
    const FEW: u64 = 256;
    let mut bytes = Vec::new();
    File::open(path)?.take(FEW).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// How long an HDF5 file says it is, by its superblock; `None` where that is not told as usual.
#[must_use]
pub fn length_told(begins: &[u8]) -> Option<u64> {
    let byte = |at: usize| begins.get(at).copied();
    // HDF5 File Format Specification 3.0, II.A: by version of the superblock where the size of
    // addresses, the base address and that of the end of the file are.
    let (size, base, end) = match byte(8)? {
        0 => (byte(13)?, 24, 40),
        1 => (byte(13)?, 28, 44),
        2 | 3 => (byte(9)?, 12, 28),
        _ => return None,
    };
    let address = |at: usize| -> Option<u64> {
        let bytes = begins.get(at..at + 8)?;
        Some(u64::from_le_bytes(bytes.try_into().ok()?))
    };
    (is_hdf5(begins) && size == 8 && address(base)? == 0).then(|| address(end))?
}

/// The text of a file, of at most 256 MiB.
///
/// # Errors
/// As [`read_bytes`]; what is no UTF-8.
pub fn read_text(path: &Path) -> io::Result<String> {
    String::from_utf8(read_bytes(path)?).map_err(|e| {
        let reason = match is_hdf5(e.as_bytes()) {
            true => "it is a result file (HDF5), where a text file is wanted",
            false => "stream did not contain valid UTF-8",
        };
        io::Error::new(io::ErrorKind::InvalidData, reason)
    })
}

/// Puts a text file in place whole: written beside it under a hidden name, flushed and renamed.
///
/// # Errors
/// Those of [`Draft::begin`], [`FileError::Create`], [`FileError::Write`] and
/// [`FileError::Rename`]; an older file under the name is then still there.
pub fn write_text(path: &Path, text: &str) -> Result<(), FileError> {
    write_bytes(path, text.as_bytes())
}

/// As [`write_text`], for a file of any kind.
///
/// # Errors
/// Those of [`write_text`].
pub fn write_bytes(path: &Path, bytes: &[u8]) -> Result<(), FileError> {
    let draft = Draft::begin(path)?;
    let at = || draft.path().to_owned();
    let mut file =
        File::create(draft.hidden()).map_err(|source| FileError::Create { path: at(), source })?;
    let written = file.write_all(bytes).and_then(|()| file.sync_all());
    drop(file);
    written.map_err(|source| FileError::Write { path: at(), source })?;
    draft.publish().map(drop)
}

/// Puts files in place together: all are written under hidden names in `beside`, a directory of the
/// same file system, before any gets its own. Parent directories are made then.
///
/// # Errors
/// As [`write_text`]; where one cannot be written none is in place.
pub fn write_together(files: &[(PathBuf, Vec<u8>)], beside: &Path) -> Result<(), FileError> {
    let mut drafts = Vec::with_capacity(files.len());
    for (path, bytes) in files {
        let path = target(path)?;
        make(beside)?;
        let draft = hidden(beside, path.file_name().unwrap_or_default());
        fs::write(draft.path(), bytes).map_err(|source| FileError::Write {
            path: path.clone(),
            source,
        })?;
        drafts.push((path, draft));
    }
    for (path, draft) in drafts {
        make(directory_of(&path))?;
        draft
            .publish(&path)
            .map_err(|source| FileError::Rename { path, source })?;
    }
    Ok(())
}

/// Whether files can be made in a directory: by making one, which is taken away again.
///
/// # Errors
/// Those of making it.
pub fn can_hold(directory: &Path) -> io::Result<()> {
    let trial = hidden(directory, "costate".as_ref());
    File::create_new(trial.path()).map(drop)
}

/// A hidden name in a directory for a file to be called so. It names the machine, which may share
/// the directory with others, and the process.
fn hidden(directory: &Path, name: &OsStr) -> Temporary {
    Temporary::new(hidden_name(directory, name))
}

fn hidden_name(directory: &Path, name: &OsStr) -> PathBuf {
    let serial = TEMPORARIES.fetch_add(1, Ordering::Relaxed);
    let mut hidden = OsString::from(".");
    hidden.push(name);
    hidden.push(format!(
        ".{}-{}-{serial}.tmp",
        machine(),
        std::process::id()
    ));
    directory.join(hidden)
}

/// Removes what processes that were killed have left of a file: hidden files for it, also for its
/// own hidden ones, of processes of this machine that are no more.
fn clear_leftovers(directory: &Path, name: &OsStr) {
    let Ok(entries) = fs::read_dir(directory) else {
        return;
    };
    let name = name.to_string_lossy();
    for path in entries.filter_map(|e| Some(e.ok()?.path())) {
        let file = path.file_name().unwrap_or_default().to_string_lossy();
        // One dot more for a hidden file of a hidden one.
        let rest = file.trim_start_matches('.').strip_prefix(&*name);
        let owner = rest.filter(|_| file.starts_with('.')).and_then(owner);
        if owner.is_some_and(|process| !is_running(process)) {
            // What cannot be removed does no harm.
            let _ = fs::remove_file(&path);
        }
    }
}

/// The process of this machine that a hidden name's ending tells.
fn owner(ending: &str) -> Option<u32> {
    let ending = ending.strip_suffix(".tmp")?.strip_prefix('.')?;
    let last = ending.rsplit_once(".tmp.").map_or(ending, |(_, last)| last);
    let (rest, serial) = last.rsplit_once('-')?;
    let (host, process) = rest.rsplit_once('-')?;
    serial.parse::<u64>().ok()?;
    process.parse().ok().filter(|_| host == machine())
}

/// Whether a process of this machine is running.
fn is_running(process: u32) -> bool {
    #[cfg(unix)]
    {
        let Ok(process) = libc::pid_t::try_from(process) else {
            return false;
        };
        // SAFETY: signal 0 only asks.
        let asked = unsafe { libc::kill(process, 0) };
        asked == 0 || io::Error::last_os_error().raw_os_error() != Some(libc::ESRCH)
    }
    #[cfg(not(unix))]
    {
        // Not known: it may be.
        let _ = process;
        true
    }
}

/// The name of this machine, for names of files.
fn machine() -> &'static str {
    static NAME: std::sync::LazyLock<String> = std::sync::LazyLock::new(|| {
        #[cfg(unix)]
        {
            let mut name = [0u8; 256];
            // SAFETY: the buffer is as long as is said, and its last byte stays 0.
            let rc = unsafe { libc::gethostname(name.as_mut_ptr().cast(), name.len() - 1) };
            let end = name.iter().position(|b| *b == 0).unwrap_or(0);
            let text = String::from_utf8_lossy(&name[..end]);
            let letters = text.chars().filter(|c| c.is_ascii_alphanumeric());
            let letters: String = letters.take(32).collect();
            if rc == 0 && !letters.is_empty() {
                return letters;
            }
        }
        "host".to_owned()
    });
    &NAME
}

/// Lets this process have so many files open at once, as far as it may: systems begin with some
/// hundred.
pub fn allow_open(count: usize) {
    #[cfg(unix)]
    {
        let wanted = count as libc::rlim_t;
        let mut limit = libc::rlimit {
            rlim_cur: 0,
            rlim_max: 0,
        };
        // SAFETY: both calls get a limit of this process, which lives as long as they do.
        unsafe {
            if libc::getrlimit(libc::RLIMIT_NOFILE, &raw mut limit) == 0 && limit.rlim_cur < wanted
            {
                limit.rlim_cur = wanted.min(limit.rlim_max);
                libc::setrlimit(libc::RLIMIT_NOFILE, &raw const limit);
            }
        }
    }
    #[cfg(not(unix))]
    let _ = count;
}

/// Makes a directory that may be there.
///
/// # Errors
/// [`FileError::CreateDirectory`].
pub fn make(directory: &Path) -> Result<(), FileError> {
    fs::create_dir_all(directory).map_err(|source| FileError::CreateDirectory {
        directory: directory.to_owned(),
        source,
    })
}

/// The directory that a file lies in.
pub fn directory_of(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

/// Makes a rename durable, where directories can be flushed.
fn sync_directory(directory: &Path) -> io::Result<()> {
    if cfg!(unix) {
        File::open(directory)?.sync_all()?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::testing::TemporaryDirectory;
    use super::*;

    #[test]
    fn what_killed_processes_left_is_cleared() {
        let directory = TemporaryDirectory::new("leftovers");
        let path = directory.path().join("r.h5");
        // No process has this number: it is above what any system gives.
        let (host, dead, own) = (machine(), i32::MAX, std::process::id());
        let gone = [
            format!(".r.h5.{host}-{dead}-0.tmp"),
            format!("..r.h5.{host}-{dead}-0.tmp.{host}-{dead}-2.tmp"),
        ];
        let kept = [
            // No name that this process gives.
            format!(".r.h5.{host}-{own}-{}.tmp", u32::MAX),
            format!(".r.h5.another-{dead}-0.tmp"),
            format!(".other.h5.{host}-{dead}-0.tmp"),
            ".r.h5.mine".to_owned(),
            "r.h5".to_owned(),
        ];
        for name in gone.iter().chain(&kept) {
            fs::write(directory.path().join(name), "x").unwrap();
        }
        drop(Draft::begin(&path).unwrap());
        let there = entries(directory.path());
        assert!(gone.iter().all(|name| !there.contains(name)), "{there:?}");
        assert!(kept.iter().all(|name| there.contains(name)), "{there:?}");
    }

    fn entries(directory: &Path) -> Vec<String> {
        let mut names: Vec<String> = fs::read_dir(directory)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn a_text_is_there_whole_or_not_at_all() {
        let directory = TemporaryDirectory::new("text");
        let path = directory.path().join("picture.svg");
        for text in ["first", "second"] {
            write_text(&path, text).unwrap();
            assert_eq!(fs::read_to_string(&path).unwrap(), text);
        }
        let taken = directory.path().join("taken");
        fs::create_dir(&taken).unwrap();
        assert!(matches!(
            write_text(&taken, "no"),
            Err(FileError::TargetIsDirectory { .. })
        ));
        // Together: where one cannot be, none is.
        let both = [
            (directory.path().join("pictures/a.svg"), b"a".to_vec()),
            (taken.clone(), b"no".to_vec()),
        ];
        assert!(write_together(&both, directory.path()).is_err());
        assert_eq!(entries(directory.path()), ["picture.svg", "taken"]);
        write_together(&both[..1], directory.path()).unwrap();
        assert_eq!(fs::read(&both[0].0).unwrap(), b"a");
        fs::remove_dir_all(directory.path().join("pictures")).unwrap();
        // What is dropped takes the directories with it that were made for it.
        drop(Draft::begin(&directory.path().join("new/sub/table.csv")).unwrap());
        assert_eq!(entries(directory.path()), ["picture.svg", "taken"]);
        // A missing directory is made, as for result files.
        write_text(&directory.path().join("new/sub/table.csv"), "x").unwrap();
        assert_eq!(entries(directory.path()), ["new", "picture.svg", "taken"]);
    }
}
