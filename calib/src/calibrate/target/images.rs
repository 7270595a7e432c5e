//! Image files: which there are, and their grey values, one at a time.

use crate::offline::edges::grey_image::GreyImage;
use image::{ColorType, DynamicImage, ImageDecoder, ImageReader};
use std::path::{Path, PathBuf};

/// Maximum number of pixels of an image that is read: cameras have fewer, and more would fill the memory.
const MAX_PIXELS: u64 = 120_000_000;
/// Maximum number of files that one pattern may match.
const MAX_FILES: usize = 20_000;

/// What is known of an image file.
#[derive(Clone, Debug, PartialEq)]
pub struct ImageFile {
    /// The image.
    pub grey: GreyImage,
    /// The file's EXIF tag asks for a rotation for display (phones and editors write it, camera drivers do not).
    pub turned: bool,
}

/// Why images cannot be read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ImageError {
    /// The pattern cannot be read.
    #[error("{option} {pattern}: {problem}; give a pattern in quotes, such as \"left*.png\", or a folder")]
    Pattern {
        /// Which option.
        option: String,
        /// What was typed.
        pattern: String,
        /// What is wrong.
        problem: String,
    },
    /// A file cannot be used.
    #[error("{path}: {problem}; give PNG, JPEG or PGM images as the camera delivers them")]
    File {
        /// The file.
        path: String,
        /// What is wrong.
        problem: String,
    },
}

/// The image files that a pattern or a folder names, in the order of their names, numbers by value (`left2` before
/// `left10`).
///
/// # Errors
/// An invalid pattern, one that matches no file, or one that matches too many.
pub fn list_images(option: &str, pattern: &str) -> Result<Vec<PathBuf>, ImageError> {
    let refuse =
        |problem: String| ImageError::Pattern { option: option.to_owned(), pattern: pattern.to_owned(), problem };
    let is_image = |p: &Path| {
        let end = p.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
        ["png", "jpg", "jpeg", "pgm", "pnm", "ppm", "bmp", "tif", "tiff"].contains(&end.as_str())
    };
    let mut files = Vec::new();
    if Path::new(pattern).is_dir() {
        for entry in std::fs::read_dir(pattern).map_err(|e| refuse(e.to_string()))? {
            let path = entry.map_err(|e| refuse(e.to_string()))?.path();
            if is_image(&path) {
                files.push(path);
            }
            if files.len() > MAX_FILES {
                break;
            }
        }
    } else {
        let found = glob::glob(pattern).map_err(|e| refuse(e.msg.to_owned()))?;
        files.extend(found.filter_map(Result::ok).filter(|p| p.is_file()).take(MAX_FILES + 1));
    }
    if files.is_empty() {
        return Err(refuse("no image file matches".to_owned()));
    }
    if files.len() > MAX_FILES {
        return Err(refuse(format!("it matches more than {MAX_FILES} files")));
    }
    files.sort_by_cached_key(|p| natural_key(&p.to_string_lossy()));
    Ok(files)
}

/// Text pieces and numbers of a name, so that 2 comes before 10.
fn natural_key(name: &str) -> Vec<(u128, String)> {
    let mut out: Vec<(u128, String)> = vec![(0, String::new())];
    let mut digits = String::new();
    for c in name.chars().chain(std::iter::once('\0')) {
        if c.is_ascii_digit() && digits.len() < 30 {
            digits.push(c);
            continue;
        }
        if !digits.is_empty() {
            out.push((digits.parse().unwrap_or(u128::MAX), String::new()));
            digits.clear();
        }
        if let Some(last) = out.last_mut()
            && c != '\0'
        {
            last.1.push(c);
        }
    }
    out
}

/// Reads an image: colour becomes grey, 16 bits become 8 by the bits that are in use. It is not rotated, whatever its
/// EXIF tag says: a calibration belongs to the sensor's rows and columns.
///
/// # Errors
/// What is wrong with the file.
pub fn read_image(path: &Path) -> Result<ImageFile, ImageError> {
    let refuse = |problem: String| ImageError::File { path: path.display().to_string(), problem };
    let reader =
        ImageReader::open(path).and_then(ImageReader::with_guessed_format).map_err(|e| refuse(e.to_string()))?;
    let mut decoder = reader.into_decoder().map_err(|e| refuse(e.to_string()))?;
    let (w, h) = decoder.dimensions();
    if w == 0 || h == 0 || u64::from(w) * u64::from(h) > MAX_PIXELS {
        return Err(refuse(format!("{w}x{h} pixels is not the size of a camera image")));
    }
    let turned = decoder.orientation().is_ok_and(|o| o != image::metadata::Orientation::NoTransforms);
    let deep = matches!(decoder.color_type(), ColorType::L16 | ColorType::La16 | ColorType::Rgb16 | ColorType::Rgba16);
    let image = DynamicImage::from_decoder(decoder).map_err(|e| refuse(e.to_string()))?;
    let grey = if deep { shallow(&image.into_luma16()) } else { image.into_luma8().into_raw() };
    let grey =
        GreyImage::new(w as usize, h as usize, grey).ok_or_else(|| refuse("the file is truncated".to_owned()))?;
    Ok(ImageFile { grey, turned })
}

/// Eight of sixteen bits: those of the brightest pixel and below, since 10 and 12 bit cameras leave the upper ones
/// empty.
fn shallow(image: &image::ImageBuffer<image::Luma<u16>, Vec<u16>>) -> Vec<u8> {
    let brightest = image.as_raw().iter().copied().max().unwrap_or(0);
    let shift = (16 - brightest.leading_zeros()).saturating_sub(8);
    image.as_raw().iter().map(|v| (v >> shift) as u8).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_ordered_by_their_numbers() {
        let mut names = vec!["left10.png", "left2.png", "left1.png", "a/left3.png", "left2b.png"];
        names.sort_by_cached_key(|n| natural_key(n));
        assert_eq!(names, ["a/left3.png", "left1.png", "left2.png", "left2b.png", "left10.png"]);
    }

    #[test]
    fn patterns_that_name_nothing_say_so() {
        let e = list_images("--left", "no/such/*.png").unwrap_err().to_string();
        assert!(e.contains("--left") && e.contains("no/such"), "{e}");
        assert!(list_images("--left", "a***").unwrap_err().to_string().contains("in quotes"));
    }

    #[test]
    fn colour_depth_and_size_are_read_or_refused() {
        let dir = std::env::temp_dir().join(format!("graspd-images-{}", std::process::id()));
        std::fs::create_dir_all(&dir).unwrap();
        let twelve_bits =
            image::ImageBuffer::<image::Luma<u16>, _>::from_fn(8, 4, |x, _| image::Luma([x as u16 * 512]));
        let path = dir.join("deep.png");
        twelve_bits.save(&path).unwrap();
        let read = read_image(&path).unwrap();
        assert_eq!((read.grey.width(), read.grey.at(7, 3), read.grey.at(1, 0), read.turned), (8, 224, 32, false));
        let colour = dir.join("colour.png");
        image::RgbImage::from_pixel(6, 5, image::Rgb([200, 200, 200])).save(&colour).unwrap();
        assert_eq!(read_image(&colour).unwrap().grey.at(2, 2), 200);
        let text = dir.join("text.png");
        std::fs::write(&text, "not an image").unwrap();
        assert!(read_image(&text).unwrap_err().to_string().contains("text.png"));
        assert_eq!(list_images("--left", &dir.display().to_string()).unwrap().len(), 3);
        std::fs::remove_dir_all(&dir).unwrap();
    }
}
