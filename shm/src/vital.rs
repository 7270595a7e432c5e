//! Watches the files through which other processes reach the daemon, because their loss has no other symptom.
//!
//! A mapped segment remains usable after its name is deleted. A tmp cleaner, `RemoveIPC` or a mistake can so leave a
//! daemon that drives the arm and that no request reaches. A segment is identified by inode, size, owner and its first
//! bytes (the version of iceoryx2), not by its modification time, which the first write through a new mapping changes.
//! A discovery file is written once and never mapped, so there the modification time counts.

use crate::ShmNode;
use crate::private::{self, FOLDER};
use std::collections::BTreeMap;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};

/// Leading bytes of a segment that iceoryx2 writes once, bytes: its version.
const HEAD: usize = 8;

/// Identity of a file: device, inode, size, owner, then its modification time or its first bytes.
type Stamp = (u64, u64, u64, u32, [u8; 16]);

fn stamp(path: &Path) -> Option<Stamp> {
    let m = std::fs::symlink_metadata(path).ok()?;
    let mut mark = [0u8; 16];
    if path.starts_with(FOLDER) {
        // A segment that is too short or unreadable gets zeros, which no intact segment starts with.
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

/// A watched file that was deleted or changed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Damage {
    /// The file.
    pub path: PathBuf,
    /// `is gone` or `was changed`.
    pub what: &'static str,
}

/// The watched files and their identities when the watch began.
#[derive(Debug, Default)]
pub struct Vital {
    files: BTreeMap<PathBuf, Stamp>,
}

fn list(folder: &Path) -> Vec<PathBuf> {
    std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path()).collect()
}

impl Vital {
    /// Watches all files of this process's node (its own, the services it has opened, the data of its ports, the node
    /// counter) and `more`. Call it when all ports exist, on an ordinary thread: it reads folders and files.
    pub fn of(node: &ShmNode, more: &[PathBuf]) -> Vital {
        let (names, number) = (node.names(), node.number());
        let own = list(&names.root().join("nodes").join(&number));
        // `<prefix><number>.port_tag` and `<prefix><hash>.service_tag` name the ports and services of this node.
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

    /// Number of watched files.
    pub fn count(&self) -> usize {
        self.files.len()
    }

    /// The first file that was deleted or changed, if any.
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

/// Paths of the segments that this process has mapped.
fn mapped_segments() -> Vec<PathBuf> {
    let maps = std::fs::read_to_string("/proc/self/maps").unwrap_or_default();
    let paths = maps.lines().filter_map(|l| l.find(FOLDER).map(|at| PathBuf::from(&l[at..])));
    paths.filter(|p| !p.to_string_lossy().ends_with("(deleted)")).collect()
}
