//! Recipes: the variables of a data package, their order, and the offset of each value.

use core::fmt;
use core::marker::PhantomData;

use super::fields::{Field, Side};
use super::frame::{HEADER, MAX_PACKAGE};
use super::message::NoRoom;
use super::value::{FieldType, Value, Wire};

/// Splits a comma-separated list into names. A trailing comma (ur_rtde writes one) or an empty list adds no name.
pub fn names(list: &str) -> impl Iterator<Item = &str> + Clone {
    let list = list.strip_suffix(',').unwrap_or(list);
    list.split(',').map(str::trim).take(if list.is_empty() { 0 } else { usize::MAX })
}

/// One entry of a controller's type list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// The variable exists and has this type.
    Type(FieldType),
    /// The controller does not know the name.
    NotFound,
    /// Another client holds this input.
    InUse,
}

impl Answer {
    /// Parses an entry.
    pub fn from_word(word: &str) -> Option<Answer> {
        match word {
            "NOT_FOUND" => Some(Answer::NotFound),
            "IN_USE" => Some(Answer::InUse),
            _ => FieldType::from_name(word).map(Answer::Type),
        }
    }
}

impl fmt::Display for Answer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Answer::Type(kind) => f.write_str(kind.name()),
            Answer::NotFound => f.write_str("NOT_FOUND"),
            Answer::InUse => f.write_str("IN_USE"),
        }
    }
}

/// Iterates over the entries of a type list; `None` for an unknown entry.
pub fn answers(list: &str) -> impl Iterator<Item = Option<Answer>> + Clone + '_ {
    names(list).map(Answer::from_word)
}

/// Joins names or types with commas into `out`.
///
/// # Errors
/// `out` is too small; its content is then undefined.
pub fn join<W: fmt::Display>(words: impl IntoIterator<Item = W>, out: &mut [u8]) -> Result<&str, NoRoom> {
    use fmt::Write;
    struct Sink<'a> {
        out: &'a mut [u8],
        len: usize,
    }
    impl Write for Sink<'_> {
        fn write_str(&mut self, s: &str) -> fmt::Result {
            let end = self.len + s.len();
            if let Some(room) = self.out.get_mut(self.len..end) {
                room.copy_from_slice(s.as_bytes());
            }
            self.len = end;
            Ok(())
        }
    }
    let mut sink = Sink { out, len: 0 };
    for (i, word) in words.into_iter().enumerate() {
        let comma = if i == 0 { "" } else { "," };
        // Writing to the sink cannot fail, but `Display` of a word may.
        if write!(sink, "{comma}{word}").is_err() {
            return Err(NoRoom { needed: usize::MAX });
        }
    }
    let needed = sink.len;
    let Sink { out, .. } = sink;
    out.get(..needed).and_then(|b| core::str::from_utf8(b).ok()).ok_or(NoRoom { needed })
}

/// Why names do not form a recipe.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RecipeError {
    /// A name is not a variable of that side.
    Unknown {
        /// Index of the name in the list.
        place: usize,
    },
    /// More fields than the recipe can hold.
    TooMany {
        /// Number of fields that it can hold.
        capacity: usize,
    },
    /// The values would not fit into one package.
    TooLong {
        /// Size of the values, bytes.
        bytes: usize,
    },
}

impl fmt::Display for RecipeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            RecipeError::Unknown { place } => {
                write!(f, "name {} of the recipe is not an RTDE variable: check its spelling", place + 1)
            }
            RecipeError::TooMany { capacity } => write!(f, "the recipe has more than {capacity} fields"),
            RecipeError::TooLong { bytes } => write!(f, "the recipe needs {bytes} bytes, more than a package can hold"),
        }
    }
}

impl core::error::Error for RecipeError {}

/// A field and the offset of its value in a data package.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Entry {
    /// The variable.
    pub field: Field,
    /// First byte of the value, from the start of the values.
    pub offset: u16,
}

/// Resolved fields in the order of the package, at most `N`.
///
/// Reads and writes by a [`FieldSlot`] check the length of the bytes: a package shorter than the recipe gives `None`,
/// never a wrong value.
///
/// ```
/// use graspd_rt::rtde::{Recipe, Side};
/// let recipe = Recipe::<8>::parse(Side::Output, "timestamp,actual_q,").unwrap();
/// assert_eq!(recipe.size(), 56);
/// let q = recipe.slot::<[f64; 6]>("actual_q").unwrap();
/// let mut values = [0u8; 56];
/// q.write(&mut values, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]).unwrap();
/// assert_eq!(q.read(&values), Some([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]));
/// assert!(recipe.slot::<f64>("actual_q").is_none(), "wrong type");
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Recipe<const N: usize> {
    entries: heapless::Vec<Entry, N>,
    size: usize,
}

impl<const N: usize> Recipe<N> {
    /// An empty recipe.
    pub const fn new() -> Recipe<N> {
        Recipe { entries: heapless::Vec::new(), size: 0 }
    }

    /// Resolves a comma-separated list of names.
    ///
    /// # Errors
    /// [`RecipeError`].
    pub fn parse(side: Side, list: &str) -> Result<Recipe<N>, RecipeError> {
        let mut recipe = Recipe::new();
        for (place, name) in names(list).enumerate() {
            recipe.push(Field::find(side, name).ok_or(RecipeError::Unknown { place })?)?;
        }
        Ok(recipe)
    }

    /// Resolves names.
    ///
    /// # Errors
    /// [`RecipeError`].
    pub fn resolve(side: Side, names: &[&str]) -> Result<Recipe<N>, RecipeError> {
        let mut recipe = Recipe::new();
        for (place, name) in names.iter().enumerate() {
            recipe.push(Field::find(side, name).ok_or(RecipeError::Unknown { place })?)?;
        }
        Ok(recipe)
    }

    /// Appends a field.
    ///
    /// # Errors
    /// [`RecipeError::TooMany`] or [`RecipeError::TooLong`].
    pub fn push(&mut self, field: Field) -> Result<(), RecipeError> {
        let bytes = self.size + field.kind().size();
        // One byte of the body is the recipe id.
        if bytes > MAX_PACKAGE - HEADER - 1 {
            return Err(RecipeError::TooLong { bytes });
        }
        let entry = Entry { field, offset: self.size as u16 };
        self.entries.push(entry).map_err(|_| RecipeError::TooMany { capacity: N })?;
        self.size = bytes;
        Ok(())
    }

    /// The fields in package order.
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// Size of the values of one data package, bytes.
    pub fn size(&self) -> usize {
        self.size
    }

    /// The slot of the variable with this name; `None` if it is not in the recipe or not of type `T`. If the variable
    /// is in the recipe twice, the first one.
    pub fn slot<T: Wire>(&self, name: &str) -> Option<FieldSlot<T>> {
        let first = self.entries.first()?;
        let field = Field::find(first.field.side(), name)?;
        if field.kind() != T::KIND {
            return None;
        }
        let entry = self.entries.iter().find(|e| e.field == field)?;
        Some(FieldSlot { offset: entry.offset, kind: PhantomData })
    }

    /// Iterates over the values of a package as [`Value`]s, up to the end of the bytes.
    pub fn values<'a>(&'a self, bytes: &'a [u8]) -> impl Iterator<Item = (Field, Value)> + 'a {
        self.entries
            .iter()
            .map_while(|e| Some((e.field, Value::decode(e.field.kind(), bytes.get(e.offset as usize..)?)?)))
    }
}

/// The offset of a value of type `T` in a data package: resolved once, read in each cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FieldSlot<T> {
    offset: u16,
    kind: PhantomData<T>,
}

impl<T: Wire> FieldSlot<T> {
    /// Reads the value; `None` if `values` is too short.
    #[inline]
    pub fn read(&self, values: &[u8]) -> Option<T> {
        T::read(values, self.offset as usize)
    }

    /// Writes the value; `None`, and nothing written, if `values` is too short.
    #[inline]
    pub fn write(&self, values: &mut [u8], value: T) -> Option<()> {
        value.write(values, self.offset as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_may_end_in_a_comma() {
        let list = |s: &'static str| names(s).collect::<heapless::Vec<_, 4>>();
        assert_eq!(list("a,b")[..], ["a", "b"]);
        assert_eq!(list("a,b,")[..], ["a", "b"]);
        assert!(list("").is_empty() && list(",").is_empty());
        assert_eq!(list("a,,b")[..], ["a", "", "b"]);
    }

    #[test]
    fn the_typical_recipe_has_the_measured_size() {
        let mut recipe = Recipe::<16>::parse(
            Side::Output,
            "timestamp,actual_q,actual_qd,target_q,target_qd,robot_mode,safety_status_bits,runtime_state,output_int_register_24",
        )
        .unwrap();
        for n in ["24", "25", "26", "27", "28", "29"] {
            let mut name = heapless::String::<32>::try_from("output_double_register_").unwrap();
            name.push_str(n).unwrap();
            recipe.push(Field::output(&name).unwrap()).unwrap();
        }
        assert_eq!(HEADER + 1 + recipe.size(), 268);
    }

    #[test]
    fn the_whole_list_fits_one_package_and_an_endless_one_does_not() {
        let mut recipe = Recipe::<2000>::new();
        for field in Field::all(Side::Output) {
            recipe.push(field).unwrap();
        }
        let q = Field::output("actual_q").unwrap();
        let refused = loop {
            if let Err(e) = recipe.push(q) {
                break e;
            }
        };
        assert!(matches!(refused, RecipeError::TooLong { bytes } if bytes > 65_000));
    }

    #[test]
    fn unknown_names_are_named_by_place() {
        let got = Recipe::<8>::parse(Side::Input, "input_int_register_24,actual_q");
        assert_eq!(got, Err(RecipeError::Unknown { place: 1 }));
        let got = Recipe::<1>::resolve(Side::Output, &["timestamp", "actual_q"]);
        assert_eq!(got, Err(RecipeError::TooMany { capacity: 1 }));
    }

    #[test]
    fn type_lists_round_trip() {
        let words = [Answer::Type(FieldType::Double), Answer::NotFound, Answer::InUse];
        let mut out = [0u8; 32];
        let list = join(words, &mut out).unwrap();
        assert_eq!(list, "DOUBLE,NOT_FOUND,IN_USE");
        assert!(answers(list).eq(words.map(Some)));
        assert!(answers("DOUBLES").eq([None]));
        assert_eq!(join(words, &mut [0u8; 8]), Err(NoRoom { needed: 23 }));
    }
}
