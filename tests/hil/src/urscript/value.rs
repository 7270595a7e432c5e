//! Values of a running script.

use std::fmt;

/// A value of a script variable. A matrix is a list of equally long lists.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// Result of a function without `return`.
    None,
    /// `True` or `False`.
    Bool(bool),
    /// 32-bit integer; arithmetic wraps as on the controller.
    Int(i32),
    /// Real number.
    Float(f64),
    /// Text; UTF-8 here, bytes on the controller.
    Str(String),
    /// `p[x, y, z, rx, ry, rz]`: metres and a rotation vector in radians.
    Pose([f64; 6]),
    /// `[...]`.
    List(Vec<Value>),
    /// `struct(name=value, ...)`: members in the order of their definition.
    Struct(Vec<(String, Value)>),
    /// Result of `rpc_factory`: URL of an XML-RPC server.
    Rpc(String),
    /// Result of `run`; never zero, because scripts use 0 for "no thread".
    Thread(u32),
}

impl Value {
    /// A list of real numbers.
    #[must_use]
    pub fn floats(values: &[f64]) -> Self {
        Self::List(values.iter().copied().map(Self::Float).collect())
    }

    /// The value as a number, if it is one.
    #[must_use]
    pub fn as_f64(&self) -> Option<f64> {
        match self {
            Self::Int(i) => Some(f64::from(*i)),
            Self::Float(f) => Some(*f),
            _ => None,
        }
    }

    /// The six numbers of a list or a pose.
    #[must_use]
    pub fn as_six(&self) -> Option<[f64; 6]> {
        match self {
            Self::Pose(p) => Some(*p),
            Self::List(items) if items.len() == 6 => {
                let mut out = [0.0; 6];
                for (o, v) in out.iter_mut().zip(items) {
                    *o = v.as_f64()?;
                }
                Some(out)
            }
            _ => None,
        }
    }

    /// Type name for messages.
    #[must_use]
    pub fn type_name(&self) -> &'static str {
        match self {
            Self::None => "nothing",
            Self::Bool(_) => "a boolean",
            Self::Int(_) => "an integer",
            Self::Float(_) => "a float",
            Self::Str(_) => "a string",
            Self::Pose(_) => "a pose",
            Self::List(_) => "a list",
            Self::Struct(_) => "a struct",
            Self::Rpc(_) => "a remote procedure call handle",
            Self::Thread(_) => "a thread",
        }
    }

    /// Number of scalars, including the value itself; bounds memory.
    pub(crate) fn weight(&self) -> usize {
        match self {
            Self::List(items) => 1 + items.iter().map(Self::weight).sum::<usize>(),
            Self::Struct(members) => 1 + members.iter().map(|(n, v)| 1 + n.len() / 8 + v.weight()).sum::<usize>(),
            Self::Str(s) | Self::Rpc(s) => 1 + s.len() / 8,
            Self::Pose(_) => 6,
            _ => 1,
        }
    }

    /// Nesting depth: 0 for a scalar, 1 for a list of scalars, 2 for a matrix.
    pub(crate) fn depth(&self) -> usize {
        match self {
            Self::List(items) => 1 + items.iter().map(Self::depth).max().unwrap_or(0),
            Self::Struct(members) => 1 + members.iter().map(|(_, v)| v.depth()).max().unwrap_or(0),
            _ => 0,
        }
    }
}

fn commas(f: &mut fmt::Formatter<'_>, items: impl Iterator<Item = impl fmt::Display>) -> fmt::Result {
    f.write_str("[")?;
    for (i, v) in items.enumerate() {
        if i > 0 {
            f.write_str(", ")?;
        }
        write!(f, "{v}")?;
    }
    f.write_str("]")
}

impl fmt::Display for Value {
    /// The form of `textmsg` and `to_str`: up to six significant digits, `True`/`False`, `p[...]`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::None => f.write_str("None"),
            Self::Bool(true) => f.write_str("True"),
            Self::Bool(false) => f.write_str("False"),
            Self::Int(i) => write!(f, "{i}"),
            Self::Float(x) => f.write_str(&short_float(*x)),
            Self::Str(s) => f.write_str(s),
            Self::Pose(p) => {
                f.write_str("p")?;
                commas(f, p.iter().map(|x| short_float(*x)))
            }
            Self::List(items) => commas(f, items.iter()),
            Self::Struct(members) => {
                f.write_str("struct(")?;
                for (i, (name, value)) in members.iter().enumerate() {
                    write!(f, "{}{name}={value}", if i > 0 { ", " } else { "" })?;
                }
                f.write_str(")")
            }
            Self::Rpc(url) => write!(f, "rpc({url})"),
            Self::Thread(id) => write!(f, "{id}"),
        }
    }
}

/// Six significant digits without trailing zeros, exponent form outside 1e-5 to 1e6, like C's `%g`.
fn short_float(x: f64) -> String {
    if x == 0.0 || !x.is_finite() {
        return format!("{x}");
    }
    let exponent = x.abs().log10().floor();
    if !(-5.0..6.0).contains(&exponent) {
        return format!("{x:.5e}");
    }
    let digits = (5.0 - exponent).clamp(0.0, 10.0) as usize;
    let text = format!("{x:.digits$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_formatted_like_the_controller_does() {
        for (x, text) in
            [(1.0, "1"), (0.1, "0.1"), (-2.5, "-2.5"), (123456.0, "123456"), (1.23456789, "1.23457"), (0.002, "0.002")]
        {
            assert_eq!(Value::Float(x).to_string(), text);
        }
        assert_eq!(Value::Pose([0.1, 0.0, 1.0, 0.0, -0.5, 3.0]).to_string(), "p[0.1, 0, 1, 0, -0.5, 3]");
        assert_eq!(Value::List(vec![Value::Int(1), Value::Bool(true)]).to_string(), "[1, True]");
    }

    #[test]
    fn as_six_accepts_exactly_six_numbers() {
        assert_eq!(Value::floats(&[1.0; 6]).as_six(), Some([1.0; 6]));
        assert_eq!(Value::floats(&[1.0; 5]).as_six(), None);
        assert_eq!(Value::List(vec![Value::Bool(true); 6]).as_six(), None);
    }
}
