//! A canvas for anti-aliased lines and areas, and for text in bitmap fonts. Positions and widths are in canvas pixels.

use embedded_graphics::Drawable;
use embedded_graphics::draw_target::DrawTarget;
use embedded_graphics::geometry::{OriginDimensions, Point as TextPoint, Size};
use embedded_graphics::mono_font::{MonoFont, MonoTextStyle, iso_8859_1};
use embedded_graphics::pixelcolor::BinaryColor;
use embedded_graphics::text::{Baseline, Text};
use graspd_rt::geom::Pixel;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use tiny_skia::{
    Color, FillRule, LineCap, LineJoin, Paint, PathBuilder, Pixmap, PremultipliedColorU8, Rect, Stroke, StrokeDash,
    Transform,
};

/// A colour as red, green, blue, opacity (0 to 255).
pub type Rgba = [u8; 4];

/// The typefaces of text.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Face {
    /// Headings.
    Bold,
    /// Figures.
    Plain,
    /// Mark numbers.
    Small,
}

impl Face {
    fn font(self) -> MonoFont<'static> {
        match self {
            Self::Bold => iso_8859_1::FONT_9X18_BOLD,
            Self::Plain => iso_8859_1::FONT_9X15,
            Self::Small => iso_8859_1::FONT_7X13_BOLD,
        }
    }

    /// Width of a character, pixels.
    pub fn advance(self) -> f64 {
        f64::from(self.font().character_size.width)
    }
}

/// A drawing with opaque pixels.
pub struct Canvas {
    /// The pixels.
    pub pixmap: Pixmap,
}

fn paint([r, g, b, a]: Rgba) -> Paint<'static> {
    let mut p = Paint::default();
    p.set_color_rgba8(r, g, b, a);
    p.anti_alias = true;
    p
}

impl Canvas {
    /// A canvas of one colour; `None` if it would have no pixels or too many.
    pub fn new(width: u32, height: u32, [r, g, b, a]: Rgba) -> Option<Self> {
        let mut pixmap = Pixmap::new(width, height)?;
        pixmap.fill(Color::from_rgba8(r, g, b, a));
        Some(Self { pixmap })
    }

    /// A polyline with a gap at each missing point. `dash` is the length of a dash and of a gap.
    pub fn line(&mut self, points: &[Option<Pixel>], colour: Rgba, width: f64, dash: Option<[f64; 2]>) {
        let mut b = PathBuilder::new();
        let mut down = false;
        for p in points {
            match p.filter(|p| p.x.abs() < 1e5 && p.y.abs() < 1e5) {
                Some(p) if down => b.line_to(p.x as f32, p.y as f32),
                Some(p) => {
                    b.move_to(p.x as f32, p.y as f32);
                    down = true;
                }
                None => down = false,
            }
        }
        let Some(path) = b.finish() else { return };
        let stroke = Stroke {
            width: width as f32,
            line_cap: LineCap::Round,
            line_join: LineJoin::Round,
            dash: dash.and_then(|d| StrokeDash::new(vec![d[0] as f32, d[1] as f32], 0.0)),
            ..Stroke::default()
        };
        self.pixmap.stroke_path(&path, &paint(colour), &stroke, Transform::identity(), None);
    }

    /// A straight line.
    pub fn segment(&mut self, a: Pixel, b: Pixel, colour: Rgba, width: f64) {
        self.line(&[Some(a), Some(b)], colour, width, None);
    }

    /// A filled polygon.
    pub fn area(&mut self, points: &[Pixel], colour: Rgba) {
        let mut b = PathBuilder::new();
        for (k, p) in points.iter().enumerate() {
            if !(p.x.abs() < 1e5 && p.y.abs() < 1e5) {
                return;
            }
            if k == 0 { b.move_to(p.x as f32, p.y as f32) } else { b.line_to(p.x as f32, p.y as f32) }
        }
        b.close();
        if let Some(path) = b.finish() {
            self.pixmap.fill_path(&path, &paint(colour), FillRule::Winding, Transform::identity(), None);
        }
    }

    /// A filled disc.
    pub fn dot(&mut self, at: Pixel, radius: f64, colour: Rgba) {
        if let Some(path) = PathBuilder::from_circle(at.x as f32, at.y as f32, radius as f32) {
            self.pixmap.fill_path(&path, &paint(colour), FillRule::Winding, Transform::identity(), None);
        }
    }

    /// A ring.
    pub fn ring(&mut self, at: Pixel, radius: f64, colour: Rgba, width: f64) {
        if let Some(path) = PathBuilder::from_circle(at.x as f32, at.y as f32, radius as f32) {
            let stroke = Stroke { width: width as f32, ..Stroke::default() };
            self.pixmap.stroke_path(&path, &paint(colour), &stroke, Transform::identity(), None);
        }
    }

    /// A filled rectangle.
    pub fn rectangle(&mut self, x: f64, y: f64, w: f64, h: f64, colour: Rgba) {
        if let Some(r) = Rect::from_xywh(x as f32, y as f32, w as f32, h as f32) {
            self.pixmap.fill_rect(r, &paint(colour), Transform::identity(), None);
        }
    }

    /// An arrow with a filled head.
    pub fn arrow(&mut self, from: Pixel, to: Pixel, colour: Rgba, width: f64) {
        let Some(d) = (to - from).try_normalize(1e-6) else { return };
        let n = Pixel::new(-d.y, d.x);
        let head = 4.5 * width;
        self.segment(from, to - d * head, colour, width);
        self.area(&[to, to - d * 1.3 * head + n * 0.55 * head, to - d * 1.3 * head - n * 0.55 * head], colour);
    }

    /// Text with its top left corner at a position; `scale` magnifies the bitmap of the font.
    pub fn text(&mut self, at: Pixel, text: &str, face: Face, scale: u32, colour: Rgba) {
        let font = face.font();
        let style = MonoTextStyle::new(&font, BinaryColor::On);
        let mut target = TextTarget {
            pixmap: &mut self.pixmap,
            x: at.x.round() as i32,
            y: at.y.round() as i32,
            scale: scale.max(1),
            colour,
        };
        // The draw target ignores pixels outside the canvas; it cannot fail.
        let _ = Text::with_baseline(text, TextPoint::zero(), style, Baseline::Top).draw(&mut target);
    }

    /// Text with a dark outline, readable on any image, centred at a position.
    pub fn label(&mut self, at: Pixel, text: &str, face: Face, scale: u32, colour: Rgba) {
        let size = face.font().character_size;
        let s = f64::from(scale.max(1));
        let w = f64::from(size.width) * s * text.chars().count() as f64;
        let top = at - Pixel::new(0.5 * w, 0.5 * f64::from(size.height) * s);
        for (dx, dy) in
            [(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0), (1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0)]
        {
            self.text(top + Pixel::new(dx, dy) * s, text, face, scale, [8, 10, 14, 230]);
        }
        self.text(top, text, face, scale, colour);
    }

    /// Copies another canvas onto this one, with its top left corner at a position.
    pub fn place(&mut self, x: i32, y: i32, other: &Self) {
        // The first row or column on this canvas, and the number of rows or columns that are cut off.
        let begin = |at: i32| (at.max(0) as usize, at.min(0).unsigned_abs() as usize);
        let ((x, left), (y, above)) = (begin(x), begin(y));
        let (own, width) = (self.pixmap.width().max(1) as usize, other.pixmap.width().max(1) as usize);
        let lines = self.pixmap.pixels_mut().chunks_exact_mut(own).skip(y);
        for (line, source) in lines.zip(other.pixmap.pixels().chunks_exact(width).skip(above)) {
            line.iter_mut().skip(x).zip(source.iter().skip(left)).for_each(|(q, s)| *q = *s);
        }
    }

    /// Fills the canvas with grey values, row by row, each times a factor from 0 to 1.
    pub fn grey(&mut self, values: &[u8], factor: f64) {
        for (pixel, v) in self.pixmap.pixels_mut().iter_mut().zip(values) {
            let g = (f64::from(*v) * factor.clamp(0.0, 1.0)) as u8;
            if let Some(c) = PremultipliedColorU8::from_rgba(g, g, g, 255) {
                *pixel = c;
            }
        }
    }

    /// The canvas as a PNG file.
    pub fn png(&self) -> Option<Vec<u8>> {
        // The pixels are opaque, so there is no alpha channel. Fast compression takes a tenth of the time for a fifth
        // more bytes.
        let opaque: Vec<u8> = self.pixmap.pixels().iter().flat_map(|p| [p.red(), p.green(), p.blue()]).collect();
        let mut file = Vec::new();
        PngEncoder::new_with_quality(&mut file, CompressionType::Fast, FilterType::Adaptive)
            .write_image(&opaque, self.pixmap.width(), self.pixmap.height(), ExtendedColorType::Rgb8)
            .ok()?;
        Some(file)
    }
}

/// A draw target that maps the bitmap font to canvas pixels.
struct TextTarget<'a> {
    pixmap: &'a mut Pixmap,
    x: i32,
    y: i32,
    scale: u32,
    colour: Rgba,
}

impl OriginDimensions for TextTarget<'_> {
    fn size(&self) -> Size {
        Size::new(self.pixmap.width(), self.pixmap.height())
    }
}

impl DrawTarget for TextTarget<'_> {
    type Color = BinaryColor;
    type Error = std::convert::Infallible;

    fn draw_iter<I>(&mut self, pixels: I) -> Result<(), Self::Error>
    where
        I: IntoIterator<Item = embedded_graphics::Pixel<BinaryColor>>,
    {
        let (w, h) = (self.pixmap.width() as i32, self.pixmap.height() as i32);
        let [r, g, b, a] = self.colour.map(u32::from);
        let s = self.scale as i32;
        for embedded_graphics::Pixel(p, on) in pixels {
            if on == BinaryColor::Off {
                continue;
            }
            for (j, i) in (0..s).flat_map(|j| (0..s).map(move |i| (j, i))) {
                let (x, y) = (self.x + p.x * s + i, self.y + p.y * s + j);
                if x < 0 || y < 0 || x >= w || y >= h {
                    continue;
                }
                if let Some(q) = self.pixmap.pixels_mut().get_mut((y * w + x) as usize) {
                    let mix = |new: u32, old: u8| ((new * a + u32::from(old) * (255 - a)) / 255) as u8;
                    let (r, g, b) = (mix(r, q.red()), mix(g, q.green()), mix(b, q.blue()));
                    // The canvas is opaque, so the colours need no premultiplication.
                    if let Some(c) = PremultipliedColorU8::from_rgba(r, g, b, 255) {
                        *q = c;
                    }
                }
            }
        }
        Ok(())
    }
}
