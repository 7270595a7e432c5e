//! The files without which nobody finds the daemon: watched, because their loss shows in nothing else.
//!
//! A mapped segment lives on when its name is deleted, so that a tmp cleaner, `RemoveIPC` or a slip leaves a daemon that
//! drives and that no verb reaches. A segment is known by its number, its size, its owner and its first bytes, iceoryx2's
//! version. Not by its modification time: the first write of a new mapping sets it. A discovery file is written once and
//! never mapped: there the time counts.

use crate::ShmNode;
use crate::private::{self, FOLDER};
use std::collections::BTreeMap;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};

/// Bytes at the beginning of a segment that iceoryx2 writes once: its version.
const HEAD: usize = 8;

/// What a file is known by: device, number, size, owner, then its modification time or its first bytes.
type Stamp = (u64, u64, u64, u32, [u8; 16]);

fn stamp(path: &Path) -> Option<Stamp> {
    let m = std::fs::symlink_metadata(path).ok()?;
    let mut mark = [0u8; 16];
    if path.starts_with(FOLDER) {
        // Shorter, or not to be read: then it is known by a head of zeros, which a sound segment has not.
        let head = std::fs::File::open(path).and_then(|f| f.read_exact_at(&mut mark[..HEAD], 0));
        if head.is_err() {
            mark = [0; 16];
        }
    } else {
        mark[..8].copy_from_slice(&m.mtime().to_le_bytes());
        mark[8..].copy_from_slice(&m.mtime_nsec().to_le_bytes());
    }
    Some((m.dev(), m.ino(), m.size(), m.uid(), mark))
}

/// What happened to a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Damage {
    /// Which.
    pub path: PathBuf,
    /// `is gone` or `was changed`.
    pub what: &'static str,
}

/// The watched files, as they were.
#[derive(Debug, Default)]
pub struct Vital {
    files: BTreeMap<PathBuf, Stamp>,
}

fn list(folder: &Path) -> Vec<PathBuf> {
    std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path()).collect()
}

impl Vital {
    /// Everything of this process's node that lasts as long as it does: its own files, the services it has opened, the
    /// data of its ports, the node counter; and `more`. Call it when all ports are made. Ordinary threads only.
    pub fn of(node: &ShmNode, more: &[PathBuf]) -> Vital {
        let (names, number) = (node.names(), node.number());
        let own = list(&names.root().join("nodes").join(&number));
        // `<prefix><number>.port_tag` and `<prefix><hash>.service_tag` say which ports and services are ours.
        let tags = |kind: &str| -> Vec<String> {
            let names = own.iter().filter(|p| p.extension().is_some_and(|e| e == kind));
            names.filter_map(|p| p.file_stem()?.to_str()?.strip_prefix(names_prefix(node)).map(str::to_owned)).collect()
        };
        let (ports, services) = (tags("port_tag"), tags("service_tag"));
        let mapped = mapped_segments();
        let data = mapped.iter().filter(|p| {
            let stem = p.file_stem().and_then(|s| s.to_str()).unwrap_or_default();
            let extension = p.extension().and_then(|e| e.to_str()).unwrap_or_default();
            extension == "dynamic" || (extension == "data" && ports.iter().any(|n| stem.ends_with(&format!("_{n}"))))
        });
        let monitors = list(&names.root().join("nodes")).into_iter().filter(|p| {
            let name = p.file_name().and_then(|n| n.to_str()).unwrap_or_default();
            name.starts_with(&format!("{}{number}.", names.prefix()))
        });
        let service = |hash: &String| names.root().join("services").join(format!("{}{hash}.service", names.prefix()));
        let counter = Path::new(FOLDER).join(private::name(names.prefix()));
        let files = (own.iter().cloned())
            .chain(monitors)
            .chain(services.iter().map(service))
            .chain(data.cloned())
            .chain(std::iter::once(counter))
            .chain(more.iter().cloned());
        Vital { files: files.filter_map(|p| stamp(&p).map(|s| (p, s))).collect() }
    }

    /// How many files are watched.
    pub fn count(&self) -> usize {
        self.files.len()
    }

    /// The first file that is not what it was.
    pub fn damage(&self) -> Option<Damage> {
        self.files.iter().find_map(|(path, was)| match stamp(path) {
            Some(now) if now == *was => None,
            Some(_) => Some(Damage { path: path.clone(), what: "was changed" }),
            None => Some(Damage { path: path.clone(), what: "is gone" }),
        })
    }
}

fn names_prefix(node: &ShmNode) -> &str {
    node.names().prefix()
}

/// Segments that this process has mapped, by their names in `/dev/shm`.
fn mapped_segments() -> Vec<PathBuf> {
    let maps = std::fs::read_to_string("/proc/self/maps").unwrap_or_default();
    let paths = maps.lines().filter_map(|l| l.find(FOLDER).map(|at| PathBuf::from(&l[at..])));
    paths.filter(|p| !p.to_string_lossy().ends_with("(deleted)")).collect()
}
