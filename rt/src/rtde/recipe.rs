//! Recipes: which variables travel in a data package, in which order, and where each one's bytes are.

use core::fmt;
use core::marker::PhantomData;

use super::fields::{Field, Side};
use super::frame::{HEADER, MAX_PACKAGE};
use super::message::NoRoom;
use super::value::{FieldType, Value, Wire};

/// Splits a comma list into names. A trailing comma (SDU's client writes one) makes no name, and neither does an empty list.
pub fn names(list: &str) -> impl Iterator<Item = &str> + Clone {
    let list = list.strip_suffix(',').unwrap_or(list);
    list.split(',').map(str::trim).take(if list.is_empty() { 0 } else { usize::MAX })
}

/// One word of a controller's type list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// The variable exists, and has this type.
    Type(FieldType),
    /// The controller does not know the name.
    NotFound,
    /// Another client holds this input.
    InUse,
}

impl Answer {
    /// From the word on the wire.
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

/// Reads a type list word by word; `None` for a word that means nothing.
pub fn answers(list: &str) -> impl Iterator<Item = Option<Answer>> + Clone + '_ {
    names(list).map(Answer::from_word)
}

/// Joins words by commas into `out`: a list of names, or of types.
///
/// # Errors
/// When `out` is too small; nothing useful is in it then.
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
        // The sink itself never fails; a word's own Display might, and then the list would be wrong.
        if write!(sink, "{comma}{word}").is_err() {
            return Err(NoRoom { needed: usize::MAX });
        }
    }
    let needed = sink.len;
    let Sink { out, .. } = sink;
    out.get(..needed).and_then(|b| core::str::from_utf8(b).ok()).ok_or(NoRoom { needed })
}

/// Why names do not make a recipe.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RecipeError {
    /// The name at this place of the list (counted from 0) is no variable of that side.
    Unknown {
        /// Place in the list.
        place: usize,
    },
    /// More fields than the recipe can hold.
    TooMany {
        /// How many it can hold.
        capacity: usize,
    },
    /// The values would not fit into one package.
    TooLong {
        /// Bytes of the values.
        bytes: usize,
    },
}

impl fmt::Display for RecipeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            RecipeError::Unknown { place } => write!(f, "name {} of the recipe is not a variable of RTDE", place + 1),
            RecipeError::TooMany { capacity } => write!(f, "recipe has more than {capacity} fields"),
            RecipeError::TooLong { bytes } => write!(f, "recipe needs {bytes} bytes, more than one package holds"),
        }
    }
}

impl core::error::Error for RecipeError {}

/// A field and the place of its bytes among the values of a data package.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Entry {
    /// The variable.
    pub field: Field,
    /// First byte, counted from the start of the values.
    pub offset: u16,
}

/// Resolved fields in package order, at most `N`.
///
/// Every read and write of a [`FieldSlot`] is checked against the bytes given, so a package that is shorter than the recipe gives
/// `None`, never a wrong value.
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

    /// Resolves a comma list of names.
    pub fn parse(side: Side, list: &str) -> Result<Recipe<N>, RecipeError> {
        let mut recipe = Recipe::new();
        for (place, name) in names(list).enumerate() {
            recipe.push(Field::find(side, name).ok_or(RecipeError::Unknown { place })?)?;
        }
        Ok(recipe)
    }

    /// Resolves names.
    pub fn resolve(side: Side, names: &[&str]) -> Result<Recipe<N>, RecipeError> {
        let mut recipe = Recipe::new();
        for (place, name) in names.iter().enumerate() {
            recipe.push(Field::find(side, name).ok_or(RecipeError::Unknown { place })?)?;
        }
        Ok(recipe)
    }

    /// Adds a field at the end.
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

    /// Bytes of the values of one data package.
    pub fn size(&self) -> usize {
        self.size
    }

    /// Where the variable of this name is; `None` if it is not in the recipe, or is not of type `T`. Of a variable that
    /// stands in the recipe twice, the first.
    pub fn slot<T: Wire>(&self, name: &str) -> Option<FieldSlot<T>> {
        let first = self.entries.first()?;
        let field = Field::find(first.field.side(), name)?;
        if field.kind() != T::KIND {
            return None;
        }
        let entry = self.entries.iter().find(|e| e.field == field)?;
        Some(FieldSlot { offset: entry.offset, kind: PhantomData })
    }

    /// The values of a package one by one, untyped; stops where the bytes end.
    pub fn values<'a>(&'a self, bytes: &'a [u8]) -> impl Iterator<Item = (Field, Value)> + 'a {
        self.entries
            .iter()
            .map_while(|e| Some((e.field, Value::decode(e.field.kind(), bytes.get(e.offset as usize..)?)?)))
    }
}

/// The place of a value of type `T` among the values of a data package: resolve once, read each cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FieldSlot<T> {
    offset: u16,
    kind: PhantomData<T>,
}

impl<T: Wire> FieldSlot<T> {
    /// The value; `None` when the bytes end before it.
    #[inline]
    pub fn read(&self, values: &[u8]) -> Option<T> {
        T::read(values, self.offset as usize)
    }

    /// Puts the value in; `None`, and nothing written, when the bytes end before it.
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
