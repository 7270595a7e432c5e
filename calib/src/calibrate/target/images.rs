//! Lists image files and reads their grey values.

use crate::offline::edges::grey_image::GreyImage;
use image::{ColorType, DynamicImage, ImageDecoder, ImageReader};
use std::path::{Path, PathBuf};

/// Maximum number of pixels of an image. Cameras have fewer; larger images would exhaust the memory.
const MAX_PIXELS: u64 = 120_000_000;
/// Maximum number of files that one pattern may match.
const MAX_FILES: usize = 20_000;

/// A decoded image file.
#[derive(Clone, Debug, PartialEq)]
pub struct ImageFile {
    /// The image.
    pub grey: GreyImage,
    /// Whether the EXIF tag requests a rotation for display (phones and editors write it, camera drivers do not).
    pub exif_rotated: bool,
}

/// Error of listing or reading images.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ImageError {
    /// The pattern is invalid or matches no usable set of files.
    #[error("{option} {pattern}: {problem}; give a pattern in quotes, such as \"left*.png\", or a folder")]
    Pattern {
        /// Name of the option.
        option: String,
        /// Value of the option.
        pattern: String,
        /// The problem.
        problem: String,
    },
    /// A file cannot be used.
    #[error("{path}: {problem}; give PNG, JPEG or PGM images as the camera delivers them")]
    File {
        /// The file.
        path: String,
        /// The problem.
        problem: String,
    },
}

/// The image files that match a pattern or are in a folder, sorted by name with numbers by value (`left2` before
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
        return Err(refuse(format!("more than {MAX_FILES} files match")));
    }
    files.sort_by_cached_key(|p| natural_key(&p.to_string_lossy()));
    Ok(files)
}

/// Sort key: the text and number parts of a name, so that 2 sorts before 10.
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

/// Reads an image and converts it to 8-bit grey; of 16 bits the upper eight that are in use are kept. An EXIF rotation
/// is not applied: a calibration refers to the rows and columns of the sensor.
///
/// # Errors
/// The problem of the file.
pub fn read_image(path: &Path) -> Result<ImageFile, ImageError> {
    let refuse = |problem: String| ImageError::File { path: path.display().to_string(), problem };
    let reader =
        ImageReader::open(path).and_then(ImageReader::with_guessed_format).map_err(|e| refuse(e.to_string()))?;
    let mut decoder = reader.into_decoder().map_err(|e| refuse(e.to_string()))?;
    let (w, h) = decoder.dimensions();
    if w == 0 || h == 0 || u64::from(w) * u64::from(h) > MAX_PIXELS {
        return Err(refuse(format!("unsupported image size {w}x{h}: an image must have 1 to {MAX_PIXELS} pixels")));
    }
    let exif_rotated = decoder.orientation().is_ok_and(|o| o != image::metadata::Orientation::NoTransforms);
    let sixteen_bits =
        matches!(decoder.color_type(), ColorType::L16 | ColorType::La16 | ColorType::Rgb16 | ColorType::Rgba16);
    let image = DynamicImage::from_decoder(decoder).map_err(|e| refuse(e.to_string()))?;
    let grey = if sixteen_bits { to_8_bits(&image.into_luma16()) } else { image.into_luma8().into_raw() };
    let grey =
        GreyImage::new(w as usize, h as usize, grey).ok_or_else(|| refuse("the file is truncated".to_owned()))?;
    Ok(ImageFile { grey, exif_rotated })
}

/// Reduces 16 bits to 8: the eight bits from the highest set bit of the brightest pixel downwards, since cameras with
/// 10 or 12 bits leave the upper bits empty.
fn to_8_bits(image: &image::ImageBuffer<image::Luma<u16>, Vec<u16>>) -> Vec<u8> {
    let brightest = image.as_raw().iter().copied().max().unwrap_or(0);
    let shift = (16 - brightest.leading_zeros()).saturating_sub(8);
    image.as_raw().iter().map(|v| (v >> shift) as u8).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_sorted_by_number_value() {
        let mut names = vec!["left10.png", "left2.png", "left1.png", "a/left3.png", "left2b.png"];
        names.sort_by_cached_key(|n| natural_key(n));
        assert_eq!(names, ["a/left3.png", "left1.png", "left2.png", "left2b.png", "left10.png"]);
    }

    #[test]
    fn patterns_without_a_match_are_reported() {
        let e = list_images("--left", "no/such/*.png").unwrap_err().to_string();
        assert!(e.contains("--left") && e.contains("no/such"), "{e}");
        assert!(list_images("--left", "a***").unwrap_err().to_string().contains("in quotes"));
    }

    #[test]
    fn colour_and_16_bit_images_are_converted_and_other_files_rejected() {
        let dir = std::env::temp_dir().join(format!("graspd-images-{}", std::process::id()));
        std::fs::create_dir_all(&dir).unwrap();
        let twelve_bits =
            image::ImageBuffer::<image::Luma<u16>, _>::from_fn(8, 4, |x, _| image::Luma([x as u16 * 512]));
        let path = dir.join("sixteen_bits.png");
        twelve_bits.save(&path).unwrap();
        let read = read_image(&path).unwrap();
        assert_eq!((read.grey.width(), read.grey.at(7, 3), read.grey.at(1, 0), read.exif_rotated), (8, 224, 32, false));
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
