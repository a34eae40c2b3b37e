//! Writing to the disk behind one that still writes.

use std::fs::File;
use std::path::Path;

/// Bytes after which the system is asked.
#[cfg(target_os = "linux")]
const BYTES: usize = 32 << 20;

/// Has the system take what is in a file to the disk while more is written: where it is asked at the
/// end alone, all wait for the disk. Elsewhere than on Linux it does nothing.
#[derive(Debug, Default)]
pub struct Behind {
    #[cfg_attr(
        not(target_os = "linux"),
        expect(dead_code, reason = "it is asked on Linux alone")
    )]
    file: Option<File>,
    bytes: usize,
}

impl Behind {
    /// For a file that is there.
    pub fn of(path: &Path) -> Self {
        Self {
            file: File::open(path).ok(),
            bytes: 0,
        }
    }

    /// So many bytes more were written.
    pub fn wrote(&mut self, bytes: usize) {
        self.bytes += bytes;
        #[cfg(target_os = "linux")]
        if let Some(file) = self.file.as_ref().filter(|_| self.bytes >= BYTES) {
            use std::os::fd::AsRawFd;
            self.bytes = 0;
            // SAFETY: the descriptor is open as long as `file`. What does not work is done at the end.
            unsafe { libc::sync_file_range(file.as_raw_fd(), 0, 0, libc::SYNC_FILE_RANGE_WRITE) };
        }
    }
}
