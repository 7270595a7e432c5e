//! Detects the target in two lists of image files; holds one image in memory at a time.

use super::{Found, ImageError, Target, find, list_images, read_image};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A pair with the target detected in both images.
#[derive(Clone, Debug, PartialEq)]
pub struct FoundPair {
    /// Name of the left image file.
    pub name: String,
    /// The target in the left and in the right image.
    pub found: [Found; 2],
}

/// Result of the detection in two lists of images.
#[derive(Clone, Debug, PartialEq)]
pub struct Collected {
    /// Pairs with the target in both images.
    pub pairs: Vec<FoundPair>,
    /// Pairs without the target: name and reason.
    pub missing: Vec<(String, String)>,
    /// Image sizes, left and right.
    pub sizes: [(u32, u32); 2],
    /// Number of pairs of files.
    pub files: usize,
    /// Number of pairs with an EXIF rotation tag; the rotation was not applied.
    pub exif_rotated: usize,
}

/// Error of the two lists of images.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CollectError {
    /// A list is invalid.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// The lists have different lengths.
    #[error("--left matches {left} images, --right {right}: the numbers must be equal; {hint}")]
    Count {
        /// Left images.
        left: usize,
        /// Right images.
        right: usize,
        /// The file that probably has no counterpart, or advice.
        hint: String,
    },
    /// A file is in both lists.
    #[error("--left and --right both match {path}: give the images of each camera separately")]
    Same {
        /// The file.
        path: String,
    },
    /// No image can be read.
    #[error("no image can be read; first error: {first}")]
    Unreadable {
        /// Error of the first image.
        first: String,
    },
}

/// Detects the target in all pairs; calls `progress` with the completed fraction.
///
/// # Errors
/// The lists are invalid. An unusable image is not an error; its pair is reported in `missing`.
pub fn collect(
    left: &str,
    right: &str,
    target: &Target,
    mut progress: impl FnMut(f64),
) -> Result<Collected, CollectError> {
    let files = [list_images("--left", left)?, list_images("--right", right)?];
    check_lists(&files)?;
    let sizes = [usual_size(&files[0])?, usual_size(&files[1])?];
    let mut out = Collected { pairs: Vec::new(), missing: Vec::new(), sizes, files: files[0].len(), exif_rotated: 0 };
    for (k, (l, r)) in files[0].iter().zip(&files[1]).enumerate() {
        progress(k as f64 / out.files as f64);
        let name = short(l);
        let mut exif_rotated = false;
        let both: Result<Vec<Found>, String> = [(l, 0), (r, 1)]
            .into_iter()
            .map(|(p, side)| find_in_file(p, target, sizes[side], &mut exif_rotated))
            .collect();
        out.exif_rotated += usize::from(exif_rotated);
        match both {
            Ok(found) => {
                if let Ok(found) = <[Found; 2]>::try_from(found) {
                    out.pairs.push(FoundPair { name, found });
                }
            }
            Err(reason) => out.missing.push((name, reason)),
        }
    }
    Ok(out)
}

/// Detects the target in one image file.
fn find_in_file(path: &Path, target: &Target, size: (u32, u32), exif_rotated: &mut bool) -> Result<Found, String> {
    let file = read_image(path).map_err(|e| e.to_string())?;
    *exif_rotated |= file.exif_rotated;
    let (w, h) = (file.grey.width() as u32, file.grey.height() as u32);
    if (w, h) != size {
        return Err(format!(
            "{}: image size mismatch: got {w}x{h}, the other images of this camera have {}x{}",
            short(path),
            size.0,
            size.1
        ));
    }
    find(&file.grey, target).map_err(|e| format!("{}: {e}", short(path)))
}

fn short(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

fn check_lists(files: &[Vec<PathBuf>; 2]) -> Result<(), CollectError> {
    let [left, right] = files;
    if let Some(same) = left.iter().find(|l| right.contains(l)) {
        return Err(CollectError::Same { path: same.display().to_string() });
    }
    if left.len() == right.len() {
        return Ok(());
    }
    // The numbers in the names identify a file without a counterpart.
    let key = |p: &Path| short(p).chars().filter(char::is_ascii_digit).collect::<String>();
    let (more, fewer) = if left.len() > right.len() { (left, right) } else { (right, left) };
    let there: std::collections::BTreeSet<String> = fewer.iter().map(|p| key(p)).collect();
    let alone = more.iter().find(|p| !there.contains(&key(p)));
    let hint = alone.map_or("remove the images without a counterpart".to_owned(), |p| {
        format!("{} seems to have no counterpart", p.display())
    });
    Err(CollectError::Count { left: left.len(), right: right.len(), hint })
}

/// The most frequent image size of a camera.
fn usual_size(files: &[PathBuf]) -> Result<(u32, u32), CollectError> {
    let mut count: BTreeMap<(u32, u32), usize> = BTreeMap::new();
    let mut first = None;
    for path in files {
        match image::ImageReader::open(path).and_then(image::ImageReader::with_guessed_format) {
            Ok(reader) => match reader.into_dimensions() {
                Ok(size) => *count.entry(size).or_insert(0) += 1,
                Err(e) => first = first.or_else(|| Some(format!("{}: {e}", path.display()))),
            },
            Err(e) => first = first.or_else(|| Some(format!("{}: {e}", path.display()))),
        }
    }
    let usual = count.into_iter().max_by_key(|(_, n)| *n).map(|(size, _)| size);
    usual.ok_or_else(|| CollectError::Unreadable { first: first.unwrap_or_default() })
}
