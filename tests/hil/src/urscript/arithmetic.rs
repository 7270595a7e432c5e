//! Operators on values: 32-bit integers that wrap, reals, element-wise lists, matrices, poses in comparisons.

use super::ast::{BinaryOp, UnaryOp};
use super::value::Value;

/// Scalars in one value; together with the number of variables this bounds a script's memory.
pub(crate) const MAX_WEIGHT: usize = 20_000;
/// Nesting depth of lists; a matrix has 2.
pub(crate) const MAX_LIST_DEPTH: usize = 4;

/// Longest string of a script.
pub(crate) const MAX_TEXT_BYTES: usize = 16_384;
/// Rows or columns of a matrix operand: far above a Jacobian, and cheap enough for one instruction.
pub(crate) const MAX_MATRIX: usize = 60;

pub(crate) type Outcome<T = Value> = Result<T, String>;

/// Refuses values that are too large or nested too deeply.
pub(crate) fn bounded(value: Value) -> Outcome {
    if value.weight() > MAX_WEIGHT {
        return Err(format!("a value of more than {MAX_WEIGHT} elements exceeds the controller's memory"));
    }
    if value.depth() > MAX_LIST_DEPTH {
        return Err(format!("lists nested more than {MAX_LIST_DEPTH} deep"));
    }
    Ok(value)
}

pub(crate) fn unary(op: UnaryOp, v: &Value) -> Outcome {
    match (op, v) {
        (UnaryOp::Not, Value::Bool(b)) => Ok(Value::Bool(!b)),
        (UnaryOp::Neg, Value::Int(i)) => Ok(Value::Int(i.wrapping_neg())),
        (UnaryOp::Neg, Value::Float(x)) => Ok(Value::Float(-x)),
        (UnaryOp::Neg | UnaryOp::Plus, Value::List(items)) => {
            items.iter().map(|x| unary(op, x)).collect::<Result<_, _>>().map(Value::List)
        }
        (UnaryOp::Plus, Value::Int(_) | Value::Float(_)) => Ok(v.clone()),
        (UnaryOp::Not, _) => Err(format!("'not' needs a boolean, got {}", v.type_name())),
        _ => Err(format!("a sign needs a number, got {}", v.type_name())),
    }
}

pub(crate) fn binary(op: BinaryOp, a: &Value, b: &Value) -> Outcome {
    use BinaryOp as B;
    match op {
        B::Eq => Ok(Value::Bool(equal(a, b))),
        B::Ne => Ok(Value::Bool(!equal(a, b))),
        B::Lt | B::Le | B::Gt | B::Ge => compare(op, a, b),
        B::Xor => match (a, b) {
            (Value::Bool(x), Value::Bool(y)) => Ok(Value::Bool(x ^ y)),
            _ => Err(format!("'xor' needs booleans, got {} and {}", a.type_name(), b.type_name())),
        },
        B::Add | B::Sub | B::Mul | B::Div | B::Mod => calculate(op, a, b),
    }
}

/// Numbers are compared by value regardless of their type; values of other types are equal only within one type.
fn equal(a: &Value, b: &Value) -> bool {
    match (a, b) {
        (Value::List(x), Value::List(y)) => x.len() == y.len() && x.iter().zip(y).all(|(x, y)| equal(x, y)),
        (Value::Thread(t), Value::Int(i)) | (Value::Int(i), Value::Thread(t)) => i64::from(*t) == i64::from(*i),
        _ => match (a.as_f64(), b.as_f64()) {
            (Some(x), Some(y)) => x == y,
            _ => a == b,
        },
    }
}

fn compare(op: BinaryOp, a: &Value, b: &Value) -> Outcome {
    let (Some(x), Some(y)) = (a.as_f64(), b.as_f64()) else {
        return Err(format!("cannot order {} and {}", a.type_name(), b.type_name()));
    };
    Ok(Value::Bool(match op {
        BinaryOp::Lt => x < y,
        BinaryOp::Le => x <= y,
        BinaryOp::Gt => x > y,
        _ => x >= y,
    }))
}

fn calculate(op: BinaryOp, a: &Value, b: &Value) -> Outcome {
    match (a, b) {
        (Value::Int(x), Value::Int(y)) => integers(op, *x, *y),
        (Value::Int(_) | Value::Float(_), Value::Int(_) | Value::Float(_)) => {
            let (x, y) = (a.as_f64().unwrap_or(0.0), b.as_f64().unwrap_or(0.0));
            reals(op, x, y)
        }
        (Value::List(x), Value::List(y)) if op == BinaryOp::Mul && is_matrix(x) => matrix_product(x, y),
        (Value::List(x), Value::List(y)) => {
            if x.len() != y.len() {
                return Err(format!("lists of {} and {} elements do not match", x.len(), y.len()));
            }
            x.iter().zip(y).map(|(x, y)| calculate(op, x, y)).collect::<Result<_, _>>().map(Value::List)
        }
        (Value::List(x), Value::Int(_) | Value::Float(_)) => {
            x.iter().map(|x| calculate(op, x, b)).collect::<Result<_, _>>().map(Value::List)
        }
        (Value::Int(_) | Value::Float(_), Value::List(y)) => {
            y.iter().map(|y| calculate(op, a, y)).collect::<Result<_, _>>().map(Value::List)
        }
        (Value::Str(x), Value::Str(y)) if op == BinaryOp::Add => concatenate(x, y),
        (Value::Str(_), _) | (_, Value::Str(_)) if op == BinaryOp::Add => Err(format!(
            "'+' needs two strings or two numbers, got {} and {}; convert with to_str",
            a.type_name(),
            b.type_name()
        )),
        _ => Err(format!("cannot calculate with {} and {}", a.type_name(), b.type_name())),
    }
}

fn concatenate(x: &str, y: &str) -> Outcome {
    if x.len() + y.len() > MAX_TEXT_BYTES {
        return Err(format!("a string of more than {MAX_TEXT_BYTES} bytes"));
    }
    Ok(Value::Str(format!("{x}{y}")))
}

/// `+ - *` and `%` of integers are integers; `/` gives a real number, on which UR's own driver scripts rely.
fn integers(op: BinaryOp, x: i32, y: i32) -> Outcome {
    if y == 0 && matches!(op, BinaryOp::Div | BinaryOp::Mod) {
        return Err("division by zero".to_owned());
    }
    Ok(match op {
        BinaryOp::Add => Value::Int(x.wrapping_add(y)),
        BinaryOp::Sub => Value::Int(x.wrapping_sub(y)),
        BinaryOp::Mul => Value::Int(x.wrapping_mul(y)),
        BinaryOp::Mod => Value::Int(x.wrapping_rem(y)),
        _ => Value::Float(f64::from(x) / f64::from(y)),
    })
}

fn reals(op: BinaryOp, x: f64, y: f64) -> Outcome {
    if y == 0.0 && matches!(op, BinaryOp::Div | BinaryOp::Mod) {
        return Err("division by zero".to_owned());
    }
    Ok(Value::Float(match op {
        BinaryOp::Add => x + y,
        BinaryOp::Sub => x - y,
        BinaryOp::Mul => x * y,
        BinaryOp::Mod => x % y,
        _ => x / y,
    }))
}

fn is_matrix(rows: &[Value]) -> bool {
    matches!(rows.first(), Some(Value::List(_)))
}

/// Product of a matrix and a matrix or a column vector.
fn matrix_product(a: &[Value], b: &[Value]) -> Outcome {
    let rows: Option<Vec<Vec<f64>>> = a.iter().map(numbers).collect();
    let rows = rows.ok_or("a matrix holds numbers only")?;
    let dot = |row: &[f64], column: &[f64]| -> Outcome<f64> {
        if row.len() != column.len() {
            return Err(format!("a matrix of {} columns cannot be multiplied by {} rows", row.len(), column.len()));
        }
        Ok(row.iter().zip(column).map(|(x, y)| x * y).sum())
    };
    if !is_matrix(b) {
        let column: Option<Vec<f64>> = b.iter().map(Value::as_f64).collect();
        let column = column.ok_or("a matrix holds numbers only")?;
        return rows.iter().map(|r| dot(r, &column).map(Value::Float)).collect::<Result<_, _>>().map(Value::List);
    }
    let right: Option<Vec<Vec<f64>>> = b.iter().map(numbers).collect();
    let right = right.ok_or("a matrix holds numbers only")?;
    let width = right.first().map_or(0, Vec::len);
    if right.iter().any(|r| r.len() != width) || width.max(rows.len()).max(right.len()) > MAX_MATRIX {
        return Err(format!("the rows of a matrix must have equal lengths, at most {MAX_MATRIX}"));
    }
    let mut out = Vec::new();
    for row in &rows {
        let line: Outcome<Vec<Value>> = (0..width)
            .map(|c| {
                let column: Vec<f64> = right.iter().filter_map(|r| r.get(c).copied()).collect();
                dot(row, &column).map(Value::Float)
            })
            .collect();
        out.push(Value::List(line?));
    }
    Ok(Value::List(out))
}

fn numbers(v: &Value) -> Option<Vec<f64>> {
    match v {
        Value::List(items) => items.iter().map(Value::as_f64).collect(),
        _ => None,
    }
}

/// The value as an integer, if it is integral.
pub(crate) fn whole(v: &Value) -> Option<i64> {
    match v {
        Value::Int(i) => Some(i64::from(*i)),
        Value::Float(x) if x.fract() == 0.0 && x.abs() < 9e15 => Some(*x as i64),
        _ => None,
    }
}

fn position(v: &Value, length: usize) -> Outcome<usize> {
    if let Value::Str(name) = v {
        return Err(format!("only a struct has members such as '{name}'"));
    }
    let i = whole(v).ok_or_else(|| format!("an index must be an integer, got {} ({v})", v.type_name()))?;
    usize::try_from(i)
        .ok()
        .filter(|i| *i < length)
        .ok_or_else(|| format!("index {i} is out of range: {length} elements, the first one is 0"))
}

/// Position of a struct's member.
fn member(members: &[(String, Value)], name: &Value) -> Outcome<usize> {
    let Value::Str(name) = name else { return Err("a struct has members, not elements".to_owned()) };
    members.iter().position(|(n, _)| n == name).ok_or_else(|| {
        let names: Vec<&str> = members.iter().map(|(n, _)| n.as_str()).collect();
        format!("the struct has no member '{name}', only {}", names.join(", "))
    })
}

/// `base[path...]`; a string in the path names a member of a struct.
pub(crate) fn element(base: &Value, path: &[Value]) -> Outcome {
    let Some((first, rest)) = path.split_first() else { return Ok(base.clone()) };
    match base {
        Value::List(items) => {
            let i = position(first, items.len())?;
            items.get(i).map_or_else(|| Err("index out of range".to_owned()), |v| element(v, rest))
        }
        Value::Pose(p) if rest.is_empty() => {
            let i = position(first, 6)?;
            Ok(Value::Float(p.get(i).copied().unwrap_or(0.0)))
        }
        Value::Struct(members) => {
            let i = member(members, first)?;
            members.get(i).map_or_else(|| Err("no such member".to_owned()), |(_, v)| element(v, rest))
        }
        other => Err(format!("{} has no elements", other.type_name())),
    }
}

/// `base[path...] = value`.
pub(crate) fn set_element(base: &mut Value, path: &[Value], value: Value) -> Outcome<()> {
    let Some((first, rest)) = path.split_first() else {
        *base = value;
        return Ok(());
    };
    match base {
        Value::List(items) => {
            let i = position(first, items.len())?;
            items.get_mut(i).map_or_else(|| Err("index out of range".to_owned()), |v| set_element(v, rest, value))
        }
        Value::Struct(members) => {
            let i = member(members, first)?;
            members.get_mut(i).map_or_else(|| Err("no such member".to_owned()), |(_, v)| set_element(v, rest, value))
        }
        Value::Pose(p) if rest.is_empty() => {
            let i = position(first, 6)?;
            let x = value
                .as_f64()
                .ok_or_else(|| format!("an element of a pose must be a number, got {}", value.type_name()))?;
            if let Some(slot) = p.get_mut(i) {
                *slot = x;
            }
            Ok(())
        }
        other => Err(format!("{} has no elements", other.type_name())),
    }
}
