//! From two lists of image files to pairs of views with the target's points in them; one image in memory at a time.

use super::{Found, ImageError, Target, find, list_images, read_image};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A pair in which the target was found twice.
#[derive(Clone, Debug, PartialEq)]
pub struct FoundPair {
    /// Name of the left image file.
    pub name: String,
    /// What was found in the left and in the right image.
    pub found: [Found; 2],
}

/// What two lists of images hold.
#[derive(Clone, Debug, PartialEq)]
pub struct Collected {
    /// Pairs with the target in both images.
    pub pairs: Vec<FoundPair>,
    /// Pairs without: name and reason.
    pub missing: Vec<(String, String)>,
    /// Image sizes, left and right.
    pub sizes: [(u32, u32); 2],
    /// Number of pairs of files.
    pub files: usize,
    /// Files whose tag says that they are to be turned; they were not.
    pub turned: usize,
}

/// Why two lists of images are no pairs.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CollectError {
    /// A list cannot be had.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// The lists have different lengths.
    #[error("--left names {left} images, --right {right}: a pair needs both; {hint}")]
    Count {
        /// Left images.
        left: usize,
        /// Right images.
        right: usize,
        /// Which is probably without its partner.
        hint: String,
    },
    /// Both lists are the same files.
    #[error("--left and --right name the same file {path}: give each camera's own images")]
    Same {
        /// One of them.
        path: String,
    },
    /// No image can be read at all.
    #[error("none of the images can be read; the first: {first}")]
    Unreadable {
        /// What is wrong with the first.
        first: String,
    },
}

/// Finds the target in all pairs; `progress` is told the part that is done.
///
/// # Errors
/// Lists that are no pairs. An image that cannot be used is no error, its pair is `missing`.
pub fn collect(
    left: &str,
    right: &str,
    target: &Target,
    mut progress: impl FnMut(f64),
) -> Result<Collected, CollectError> {
    let files = [list_images("--left", left)?, list_images("--right", right)?];
    check_lists(&files)?;
    let sizes = [usual_size(&files[0])?, usual_size(&files[1])?];
    let mut out = Collected { pairs: Vec::new(), missing: Vec::new(), sizes, files: files[0].len(), turned: 0 };
    for (k, (l, r)) in files[0].iter().zip(&files[1]).enumerate() {
        progress(k as f64 / out.files as f64);
        let name = short(l);
        let mut turned = false;
        let both: Result<Vec<Found>, String> =
            [(l, 0), (r, 1)].into_iter().map(|(p, side)| look(p, target, sizes[side], &mut turned)).collect();
        out.turned += usize::from(turned);
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

/// One image: the target, or why not.
fn look(path: &Path, target: &Target, size: (u32, u32), turned: &mut bool) -> Result<Found, String> {
    let file = read_image(path).map_err(|e| e.to_string())?;
    *turned |= file.turned;
    let (w, h) = (file.grey.width() as u32, file.grey.height() as u32);
    if (w, h) != size {
        return Err(format!(
            "{}: {w}x{h} pixels, but the others of this camera have {}x{}",
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
    // Numbers in the names tell who has no partner.
    let key = |p: &Path| short(p).chars().filter(char::is_ascii_digit).collect::<String>();
    let (more, fewer) = if left.len() > right.len() { (left, right) } else { (right, left) };
    let there: std::collections::BTreeSet<String> = fewer.iter().map(|p| key(p)).collect();
    let alone = more.iter().find(|p| !there.contains(&key(p)));
    let hint = alone.map_or("take away the images without a partner".to_owned(), |p| {
        format!("{} seems to have no partner", p.display())
    });
    Err(CollectError::Count { left: left.len(), right: right.len(), hint })
}

/// The size that most images of a camera have.
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
