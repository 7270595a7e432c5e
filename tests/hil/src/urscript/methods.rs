//! Methods of lists and matrices.

use super::arithmetic::{Outcome, whole};
use super::value::Value;

/// Result of a method: its value, and the changed list if it changes one.
pub(crate) type MethodResult = (Value, Option<Value>);

/// Calls `list.method(arguments)`. The capacity of a list is that of the largest value, whatever it was created with.
pub(crate) fn call(base: &Value, method: &str, arguments: &[Value]) -> Outcome<MethodResult> {
    let Value::List(items) = base else {
        return Err(format!("{} has no method '{method}'", base.type_name()));
    };
    if arguments.contains(&Value::None) {
        return Err(format!("an argument of '{method}' has no value"));
    }
    let mut items = items.clone();
    let value = match (method, arguments) {
        ("length", []) => return Ok((integer(items.len()), None)),
        ("to_string", []) => return Ok((Value::Str(base.to_string()), None)),
        ("shape", []) => {
            let columns = if let Some(Value::List(row)) = items.first() { row.len() } else { 0 };
            return Ok((Value::List(vec![integer(items.len()), integer(columns)]), None));
        }
        ("get_row", [i]) => return Ok((items.swap_remove(position(i, items.len())?), None)),
        ("get_column", [i]) => return column(&items, i).map(|c| (c, None)),
        ("slice", [begin, end]) => {
            let (from, to) = (position(begin, items.len() + 1)?, position(end, items.len() + 1)?);
            let part = items.get(from..to).ok_or("slice: the end is before the beginning")?;
            return Ok((Value::List(part.to_vec()), None));
        }
        ("slice", [begin]) => {
            let from = position(begin, items.len() + 1)?;
            return Ok((Value::List(items.split_off(from)), None));
        }
        ("append", [value]) => {
            items.push(value.clone());
            Value::None
        }
        ("extend", [Value::List(more)]) => {
            items.extend_from_slice(more);
            Value::None
        }
        ("insert", [i, value]) => {
            let at = position(i, items.len() + 1)?;
            items.insert(at, value.clone());
            Value::None
        }
        ("remove", [i]) => items.remove(position(i, items.len())?),
        ("pop", []) => items.pop().ok_or("pop: the list is empty")?,
        ("clear", []) => {
            items.clear();
            Value::None
        }
        ("swap_rows", [i, j]) => {
            let (i, j) = (position(i, items.len())?, position(j, items.len())?);
            items.swap(i, j);
            Value::None
        }
        _ => return Err(format!("a list has no method '{method}' with {} arguments", arguments.len())),
    };
    Ok((value, Some(Value::List(items))))
}

fn integer(n: usize) -> Value {
    Value::Int(i32::try_from(n).unwrap_or(i32::MAX))
}

fn position(v: &Value, length: usize) -> Outcome<usize> {
    whole(v)
        .and_then(|i| usize::try_from(i).ok())
        .filter(|i| *i < length)
        .ok_or_else(|| format!("position {v} is out of range: the list has {length} positions, the first one is 0"))
}

fn column(rows: &[Value], i: &Value) -> Outcome {
    let element = |row: &Value| match row {
        Value::List(items) => position(i, items.len()).map(|i| items[i].clone()),
        other => Err(format!("get_column needs a matrix, a row is {}", other.type_name())),
    };
    rows.iter().map(element).collect::<Result<_, _>>().map(Value::List)
}
