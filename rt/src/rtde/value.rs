//! Value types of RTDE fields: their names on the wire, their sizes, their bytes (big-endian, packed without padding).

use core::fmt;

/// Type of a field, as the controller names it in the answer to a recipe.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum FieldType {
    /// One byte, zero is false.
    Bool,
    /// One byte.
    Uint8,
    /// Four bytes.
    Uint32,
    /// Four bytes, two's complement.
    Int32,
    /// Eight bytes.
    Uint64,
    /// IEEE 754 double.
    Double,
    /// Three doubles.
    Vector3d,
    /// Six doubles.
    Vector6d,
    /// Six `Int32`.
    Vector6Int32,
    /// Six `Uint32`.
    Vector6Uint32,
}

impl FieldType {
    /// Every type.
    pub const ALL: [FieldType; 10] = [
        FieldType::Bool,
        FieldType::Uint8,
        FieldType::Uint32,
        FieldType::Int32,
        FieldType::Uint64,
        FieldType::Double,
        FieldType::Vector3d,
        FieldType::Vector6d,
        FieldType::Vector6Int32,
        FieldType::Vector6Uint32,
    ];

    /// Bytes on the wire.
    pub const fn size(self) -> usize {
        match self {
            FieldType::Bool | FieldType::Uint8 => 1,
            FieldType::Uint32 | FieldType::Int32 => 4,
            FieldType::Uint64 | FieldType::Double => 8,
            FieldType::Vector3d | FieldType::Vector6Int32 | FieldType::Vector6Uint32 => 24,
            FieldType::Vector6d => 48,
        }
    }

    /// Name of this type in a type list.
    pub const fn name(self) -> &'static str {
        match self {
            FieldType::Bool => "BOOL",
            FieldType::Uint8 => "UINT8",
            FieldType::Uint32 => "UINT32",
            FieldType::Int32 => "INT32",
            FieldType::Uint64 => "UINT64",
            FieldType::Double => "DOUBLE",
            FieldType::Vector3d => "VECTOR3D",
            FieldType::Vector6d => "VECTOR6D",
            FieldType::Vector6Int32 => "VECTOR6INT32",
            FieldType::Vector6Uint32 => "VECTOR6UINT32",
        }
    }

    /// The type with this name in a type list.
    pub fn from_name(word: &str) -> Option<FieldType> {
        FieldType::ALL.into_iter().find(|t| t.name() == word)
    }

    /// The zero of this type.
    pub const fn zero(self) -> Value {
        match self {
            FieldType::Bool => Value::Bool(false),
            FieldType::Uint8 => Value::Uint8(0),
            FieldType::Uint32 => Value::Uint32(0),
            FieldType::Int32 => Value::Int32(0),
            FieldType::Uint64 => Value::Uint64(0),
            FieldType::Double => Value::Double(0.0),
            FieldType::Vector3d => Value::Vector3d([0.0; 3]),
            FieldType::Vector6d => Value::Vector6d([0.0; 6]),
            FieldType::Vector6Int32 => Value::Vector6Int32([0; 6]),
            FieldType::Vector6Uint32 => Value::Vector6Uint32([0; 6]),
        }
    }
}

impl fmt::Display for FieldType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A value of any RTDE type.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value {
    /// See [`FieldType::Bool`].
    Bool(bool),
    /// See [`FieldType::Uint8`].
    Uint8(u8),
    /// See [`FieldType::Uint32`].
    Uint32(u32),
    /// See [`FieldType::Int32`].
    Int32(i32),
    /// See [`FieldType::Uint64`].
    Uint64(u64),
    /// See [`FieldType::Double`].
    Double(f64),
    /// See [`FieldType::Vector3d`].
    Vector3d([f64; 3]),
    /// See [`FieldType::Vector6d`].
    Vector6d([f64; 6]),
    /// See [`FieldType::Vector6Int32`].
    Vector6Int32([i32; 6]),
    /// See [`FieldType::Vector6Uint32`].
    Vector6Uint32([u32; 6]),
}

impl Value {
    /// The type of this value.
    pub const fn kind(&self) -> FieldType {
        match self {
            Value::Bool(_) => FieldType::Bool,
            Value::Uint8(_) => FieldType::Uint8,
            Value::Uint32(_) => FieldType::Uint32,
            Value::Int32(_) => FieldType::Int32,
            Value::Uint64(_) => FieldType::Uint64,
            Value::Double(_) => FieldType::Double,
            Value::Vector3d(_) => FieldType::Vector3d,
            Value::Vector6d(_) => FieldType::Vector6d,
            Value::Vector6Int32(_) => FieldType::Vector6Int32,
            Value::Vector6Uint32(_) => FieldType::Vector6Uint32,
        }
    }

    /// Reads a value of type `kind` from the start of `bytes`; `None` if there are too few.
    pub fn decode(kind: FieldType, bytes: &[u8]) -> Option<Value> {
        Some(match kind {
            FieldType::Bool => Value::Bool(bool::read(bytes, 0)?),
            FieldType::Uint8 => Value::Uint8(u8::read(bytes, 0)?),
            FieldType::Uint32 => Value::Uint32(u32::read(bytes, 0)?),
            FieldType::Int32 => Value::Int32(i32::read(bytes, 0)?),
            FieldType::Uint64 => Value::Uint64(u64::read(bytes, 0)?),
            FieldType::Double => Value::Double(f64::read(bytes, 0)?),
            FieldType::Vector3d => Value::Vector3d(<[f64; 3]>::read(bytes, 0)?),
            FieldType::Vector6d => Value::Vector6d(<[f64; 6]>::read(bytes, 0)?),
            FieldType::Vector6Int32 => Value::Vector6Int32(<[i32; 6]>::read(bytes, 0)?),
            FieldType::Vector6Uint32 => Value::Vector6Uint32(<[u32; 6]>::read(bytes, 0)?),
        })
    }

    /// Writes the value to the start of `out` and returns its size; `None`, and nothing written, if `out` is too short.
    pub fn encode(&self, out: &mut [u8]) -> Option<usize> {
        match self {
            Value::Bool(v) => v.write(out, 0)?,
            Value::Uint8(v) => v.write(out, 0)?,
            Value::Uint32(v) => v.write(out, 0)?,
            Value::Int32(v) => v.write(out, 0)?,
            Value::Uint64(v) => v.write(out, 0)?,
            Value::Double(v) => v.write(out, 0)?,
            Value::Vector3d(v) => v.write(out, 0)?,
            Value::Vector6d(v) => v.write(out, 0)?,
            Value::Vector6Int32(v) => v.write(out, 0)?,
            Value::Vector6Uint32(v) => v.write(out, 0)?,
        }
        Some(self.kind().size())
    }
}

mod sealed {
    pub trait Sealed {}
}

/// A Rust type for one RTDE type, which a typed [`FieldSlot`](super::FieldSlot) reads and writes.
pub trait Wire: Copy + sealed::Sealed {
    /// The RTDE type.
    const KIND: FieldType;

    /// Reads the value at byte `at`; `None` when it does not fit there.
    fn read(bytes: &[u8], at: usize) -> Option<Self>;

    /// Writes the value at byte `at`; `None`, and nothing written, when it does not fit there.
    fn write(self, out: &mut [u8], at: usize) -> Option<()>;
}

/// The `N` bytes at `at`.
#[inline]
fn chunk<const N: usize>(bytes: &[u8], at: usize) -> Option<&[u8; N]> {
    bytes.get(at..)?.first_chunk::<N>()
}

/// The `N` bytes at `at`, to write.
#[inline]
fn chunk_mut<const N: usize>(bytes: &mut [u8], at: usize) -> Option<&mut [u8; N]> {
    bytes.get_mut(at..)?.first_chunk_mut::<N>()
}

macro_rules! scalar {
    ($t:ty, $kind:ident, $n:literal) => {
        impl sealed::Sealed for $t {}
        impl Wire for $t {
            const KIND: FieldType = FieldType::$kind;
            #[inline]
            fn read(bytes: &[u8], at: usize) -> Option<Self> {
                Some(<$t>::from_be_bytes(*chunk::<$n>(bytes, at)?))
            }
            #[inline]
            fn write(self, out: &mut [u8], at: usize) -> Option<()> {
                *chunk_mut::<$n>(out, at)? = self.to_be_bytes();
                Some(())
            }
        }
    };
}

macro_rules! vector {
    ($e:ty, $len:literal, $width:literal, $kind:ident) => {
        impl sealed::Sealed for [$e; $len] {}
        impl Wire for [$e; $len] {
            const KIND: FieldType = FieldType::$kind;
            #[inline]
            fn read(bytes: &[u8], at: usize) -> Option<Self> {
                let raw = chunk::<{ $len * $width }>(bytes, at)?;
                let mut out = [<$e>::default(); $len];
                for (o, b) in out.iter_mut().zip(raw.as_chunks::<$width>().0) {
                    *o = <$e>::from_be_bytes(*b);
                }
                Some(out)
            }
            #[inline]
            fn write(self, out: &mut [u8], at: usize) -> Option<()> {
                let raw = chunk_mut::<{ $len * $width }>(out, at)?;
                for (v, b) in self.iter().zip(raw.as_chunks_mut::<$width>().0) {
                    *b = v.to_be_bytes();
                }
                Some(())
            }
        }
    };
}

scalar!(u8, Uint8, 1);
scalar!(u32, Uint32, 4);
scalar!(i32, Int32, 4);
scalar!(u64, Uint64, 8);
scalar!(f64, Double, 8);
vector!(f64, 3, 8, Vector3d);
vector!(f64, 6, 8, Vector6d);
vector!(i32, 6, 4, Vector6Int32);
vector!(u32, 6, 4, Vector6Uint32);

impl sealed::Sealed for bool {}
impl Wire for bool {
    const KIND: FieldType = FieldType::Bool;
    #[inline]
    fn read(bytes: &[u8], at: usize) -> Option<Self> {
        Some(*bytes.get(at)? != 0)
    }
    #[inline]
    fn write(self, out: &mut [u8], at: usize) -> Option<()> {
        *out.get_mut(at)? = self as u8;
        Some(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_type_has_its_literal_bytes() {
        let cases: [(Value, &[u8]); 8] = [
            (Value::Bool(true), &[1]),
            (Value::Uint8(0xfe), &[0xfe]),
            (Value::Uint32(0x0102_0304), &[1, 2, 3, 4]),
            (Value::Int32(-2), &[0xff, 0xff, 0xff, 0xfe]),
            (Value::Uint64(0x0102_0304_0506_0708), &[1, 2, 3, 4, 5, 6, 7, 8]),
            (Value::Double(1.0), &[0x3f, 0xf0, 0, 0, 0, 0, 0, 0]),
            (
                Value::Vector3d([1.0, -2.0, 0.5]),
                &[0x3f, 0xf0, 0, 0, 0, 0, 0, 0, 0xc0, 0, 0, 0, 0, 0, 0, 0, 0x3f, 0xe0, 0, 0, 0, 0, 0, 0],
            ),
            (
                Value::Vector6Int32([0, 1, -1, 2, -2, 253]),
                &[0, 0, 0, 0, 0, 0, 0, 1, 255, 255, 255, 255, 0, 0, 0, 2, 255, 255, 255, 254, 0, 0, 0, 253],
            ),
        ];
        for (value, bytes) in cases {
            let mut out = [0u8; 48];
            assert_eq!(value.encode(&mut out), Some(bytes.len()));
            assert_eq!(&out[..bytes.len()], bytes);
            assert_eq!(Value::decode(value.kind(), bytes), Some(value));
            assert_eq!(Value::decode(value.kind(), &bytes[..bytes.len() - 1]), None);
            assert_eq!(value.encode(&mut out[..bytes.len() - 1]), None);
        }
    }

    #[test]
    fn names_and_sizes_agree_with_the_zero() {
        for kind in FieldType::ALL {
            assert_eq!(FieldType::from_name(kind.name()), Some(kind));
            let mut out = [0u8; 48];
            assert_eq!(kind.zero().encode(&mut out), Some(kind.size()));
            assert_eq!(Value::decode(kind, &out), Some(kind.zero()));
        }
        assert_eq!(FieldType::from_name("NOT_FOUND"), None);
    }
}
