//! Built-in functions that depend only on their arguments.

use super::arithmetic::{MAX_MATRIX, MAX_TEXT_BYTES, Outcome, whole};
use super::value::Value;
use nalgebra::{DMatrix, Isometry3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// Length limit of `make_list`, exclusive.
const MAX_LIST: usize = 10_000;

pub(crate) fn number(v: &Value) -> Outcome<f64> {
    v.as_f64().ok_or_else(|| format!("expected a number, got {}", v.type_name()))
}

/// A finite number; NaN must not reach a motion.
pub(crate) fn finite(v: &Value) -> Outcome<f64> {
    let x = number(v)?;
    if x.is_finite() { Ok(x) } else { Err(format!("expected a finite number, got {x}")) }
}

pub(crate) fn six(v: &Value) -> Outcome<[f64; 6]> {
    let values = v.as_six().ok_or_else(|| format!("expected six numbers, got {} ({v})", v.type_name()))?;
    if values.iter().all(|x| x.is_finite()) { Ok(values) } else { Err(format!("expected six finite numbers, got {v}")) }
}

pub(crate) fn pose(v: &Value) -> Outcome<[f64; 6]> {
    match v {
        Value::Pose(_) => six(v),
        _ => Err(format!("expected a pose p[...], got {}", v.type_name())),
    }
}

pub(crate) fn text(v: &Value) -> Outcome<&str> {
    match v {
        Value::Str(s) => Ok(s),
        _ => Err(format!("expected a string, got {}", v.type_name())),
    }
}

pub(crate) fn boolean(v: &Value) -> Outcome<bool> {
    match v {
        Value::Bool(b) => Ok(*b),
        _ => Err(format!("expected a boolean, got {}", v.type_name())),
    }
}

/// An integer from 0 to `limit` - 1.
pub(crate) fn index(v: &Value, limit: usize) -> Outcome<usize> {
    whole(v)
        .and_then(|i| usize::try_from(i).ok())
        .filter(|i| *i < limit)
        .ok_or_else(|| format!("expected an integer from 0 to {}, got {v}", limit - 1))
}

pub(crate) fn int32(v: &Value) -> Outcome<i32> {
    whole(v)
        .and_then(|i| i32::try_from(i).ok())
        .ok_or_else(|| format!("expected a 32-bit integer, got {} ({v})", v.type_name()))
}

fn isometry(p: &[f64; 6]) -> Isometry3<f64> {
    let [x, y, z, rx, ry, rz] = *p;
    Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_scaled_axis(Vector3::new(rx, ry, rz)))
}

fn from_isometry(i: &Isometry3<f64>) -> Value {
    let (t, r) = (i.translation.vector, i.rotation.scaled_axis());
    Value::Pose([t.x, t.y, t.z, r.x, r.y, r.z])
}

fn frame(v: &Value) -> Outcome<Isometry3<f64>> {
    Ok(isometry(&pose(v)?))
}

fn three(v: &Value) -> Outcome<Vector3<f64>> {
    match v {
        Value::List(items) => match items.as_slice() {
            [x, y, z] => Ok(Vector3::new(number(x)?, number(y)?, number(z)?)),
            _ => Err(format!("expected three numbers, got {}", items.len())),
        },
        Value::Pose(p) => Ok(Vector3::new(p[0], p[1], p[2])),
        _ => Err(format!("expected three numbers, got {}", v.type_name())),
    }
}

fn list(v: &Value) -> Outcome<Vec<f64>> {
    match v {
        Value::List(items) => items.iter().map(number).collect(),
        Value::Pose(p) => Ok(p.to_vec()),
        _ => Err(format!("expected a list, got {}", v.type_name())),
    }
}

fn domain(function: &str, x: f64) -> Outcome {
    if x.is_finite() { Ok(Value::Float(x)) } else { Err(format!("{function}: the argument is outside its domain")) }
}

fn rounded(x: f64) -> Outcome {
    if x.abs() <= f64::from(i32::MAX) { Ok(Value::Int(x as i32)) } else { Err(format!("{x} does not fit 32 bits")) }
}

/// Calls a pure built-in with bound arguments; `None` if `name` is not one.
pub(crate) fn call(name: &str, a: &[Value]) -> Option<Outcome> {
    let none = Value::None;
    let [x, y, z] = [0, 1, 2].map(|i| a.get(i).unwrap_or(&none));
    Some(match name {
        "sin" => number(x).map(|x| Value::Float(x.sin())),
        "cos" => number(x).map(|x| Value::Float(x.cos())),
        "tan" => number(x).map(|x| Value::Float(x.tan())),
        "asin" => number(x).and_then(|x| domain(name, x.asin())),
        "acos" => number(x).and_then(|x| domain(name, x.acos())),
        "atan" => number(x).map(|x| Value::Float(x.atan())),
        "atan2" => number(x).and_then(|x| Ok(Value::Float(x.atan2(number(y)?)))),
        "sqrt" => number(x).and_then(|x| domain(name, x.sqrt())),
        "pow" => number(x).and_then(|x| domain(name, x.powf(number(y)?))),
        "log" => number(x).and_then(|b| domain(name, number(y)?.log(b))),
        "floor" => number(x).and_then(|x| rounded(x.floor())),
        "ceil" => number(x).and_then(|x| rounded(x.ceil())),
        "d2r" => number(x).map(|x| Value::Float(x.to_radians())),
        "r2d" => number(x).map(|x| Value::Float(x.to_degrees())),
        "norm" => norm(x),
        "normalize" => normalize(x),
        "length" | "get_list_length" => count(x),
        "size" => size(x),
        "transpose" => transpose(x),
        "inv" => inverse(x),
        "make_list" => index(x, MAX_LIST).map(|n| Value::List(vec![y.clone(); n])),
        "binary_list_to_integer" => bits_to_integer(x),
        "integer_to_binary_list" => {
            int32(x).map(|i| Value::List((0..32).map(|b| Value::Bool((i >> b) & 1 == 1)).collect()))
        }
        "pose_trans" => frame(x).and_then(|p| Ok(from_isometry(&(p * frame(y)?)))),
        "pose_inv" => frame(x).map(|p| from_isometry(&p.inverse())),
        "pose_add" => frame(x).and_then(|p| {
            let q = frame(y)?;
            let t = Translation3::from(p.translation.vector + q.translation.vector);
            Ok(from_isometry(&Isometry3::from_parts(t, p.rotation * q.rotation)))
        }),
        "pose_sub" => frame(x).and_then(|to| {
            let from = frame(y)?;
            let t = Translation3::from(to.translation.vector - from.translation.vector);
            Ok(from_isometry(&Isometry3::from_parts(t, to.rotation * from.rotation.inverse())))
        }),
        "pose_dist" | "point_dist" => three(x).and_then(|p| Ok(Value::Float((three(y)? - p).norm()))),
        "wrench_trans" => wrench_trans(x, y),
        "interpolate_pose" => frame(x).and_then(|from| {
            let (to, s) = (frame(y)?, finite(z)?);
            let t = from.translation.vector.lerp(&to.translation.vector, s);
            let turn = (from.rotation.inverse() * to.rotation).scaled_axis() * s;
            let rotation = from.rotation * UnitQuaternion::from_scaled_axis(turn);
            Ok(from_isometry(&Isometry3::from_parts(Translation3::from(t), rotation)))
        }),
        "rotvec2rpy" => three(x).map(|r| {
            let (roll, pitch, yaw) = Rotation3::from_scaled_axis(r).euler_angles();
            Value::floats(&[roll, pitch, yaw])
        }),
        "rpy2rotvec" => three(x).map(|r| {
            let v = Rotation3::from_euler_angles(r.x, r.y, r.z).scaled_axis();
            Value::floats(&[v.x, v.y, v.z])
        }),
        "to_str" => Ok(Value::Str(x.to_string())),
        "to_num" => text(x).and_then(to_number),
        "str_cat" => concatenate(x, y),
        "str_len" => text(x).map(|s| Value::Int(i32::try_from(s.chars().count()).unwrap_or(i32::MAX))),
        "str_empty" => text(x).map(|s| Value::Bool(s.is_empty())),
        "str_at" => text(x).and_then(|s| slice(s, y, 1)),
        "str_sub" => text(x).and_then(|s| match z {
            Value::None => slice(s, y, usize::MAX),
            n => slice(s, y, index(n, MAX_TEXT_BYTES)?),
        }),
        "str_find" => find(x, y, z),
        _ => return None,
    })
}

/// Transforms a wrench into the frame at `from_to`.
fn wrench_trans(from_to: &Value, wrench: &Value) -> Outcome {
    let (frame, w) = (frame(from_to)?, six(wrench)?);
    let (force, torque) = (Vector3::new(w[0], w[1], w[2]), Vector3::new(w[3], w[4], w[5]));
    let back = frame.rotation.inverse();
    let f = back * force;
    let t = back * (torque - frame.translation.vector.cross(&force));
    Ok(Value::floats(&[f.x, f.y, f.z, t.x, t.y, t.z]))
}

/// Absolute value of a number, Euclidean norm of a list, or of the position of a pose.
fn norm(v: &Value) -> Outcome {
    match v {
        Value::Int(i) => Ok(Value::Int(i.wrapping_abs())),
        Value::Float(x) => Ok(Value::Float(x.abs())),
        Value::Pose(_) => three(v).map(|p| Value::Float(p.norm())),
        _ => list(v).map(|l| Value::Float(l.iter().map(|x| x * x).sum::<f64>().sqrt())),
    }
}

fn normalize(v: &Value) -> Outcome {
    let items = list(v)?;
    let n = items.iter().map(|x| x * x).sum::<f64>().sqrt();
    if n > 0.0 && n.is_finite() {
        Ok(Value::floats(&items.iter().map(|x| x / n).collect::<Vec<_>>()))
    } else {
        Err("normalize: the list has zero length".to_owned())
    }
}

fn count(v: &Value) -> Outcome {
    let n = match v {
        Value::List(items) => items.len(),
        Value::Pose(_) => 6,
        Value::Str(s) => s.chars().count(),
        _ => return Err(format!("{} has no length", v.type_name())),
    };
    Ok(Value::Int(i32::try_from(n).unwrap_or(i32::MAX)))
}

fn transpose(v: &Value) -> Outcome {
    let Value::List(rows) = v else { return Err(format!("expected a matrix, got {}", v.type_name())) };
    let rows: Vec<Vec<f64>> = rows.iter().map(list).collect::<Result<_, _>>()?;
    let width = rows.first().map_or(0, Vec::len);
    if rows.iter().any(|r| r.len() != width) {
        return Err("the rows of a matrix must have equal lengths".to_owned());
    }
    let column = |c: usize| Value::List(rows.iter().filter_map(|r| r.get(c).map(|x| Value::Float(*x))).collect());
    Ok(Value::List((0..width).map(column).collect()))
}

/// Number of elements; rows and columns of a matrix.
fn size(v: &Value) -> Outcome {
    match v {
        Value::List(rows) => match rows.first() {
            Some(Value::List(row)) => Ok(Value::List(
                [rows.len(), row.len()].iter().map(|n| Value::Int(i32::try_from(*n).unwrap_or(i32::MAX))).collect(),
            )),
            _ => count(v),
        },
        _ => count(v),
    }
}

/// Inverse of a square matrix or of a pose.
fn inverse(v: &Value) -> Outcome {
    if let Value::Pose(_) = v {
        return frame(v).map(|p| from_isometry(&p.inverse()));
    }
    let Value::List(rows) = v else { return Err(format!("inv: expected a matrix or a pose, got {}", v.type_name())) };
    let rows: Vec<Vec<f64>> = rows.iter().map(list).collect::<Result<_, _>>().map_err(|e| format!("inv: {e}"))?;
    let n = rows.len();
    if n == 0 || n > MAX_MATRIX || rows.iter().any(|r| r.len() != n) {
        return Err(format!("inv: the matrix must be square with at most {MAX_MATRIX} rows"));
    }
    let m = DMatrix::from_row_iterator(n, n, rows.into_iter().flatten());
    // Adding zero turns the negative zeros of the elimination into zeros.
    let inverse = m.try_inverse().filter(|m| m.iter().all(|x| x.is_finite())).ok_or("inv: the matrix is singular")?;
    Ok(Value::List(
        inverse.row_iter().map(|r| Value::List(r.iter().map(|x| Value::Float(*x + 0.0)).collect())).collect(),
    ))
}

fn bits_to_integer(v: &Value) -> Outcome {
    let Value::List(bits) = v else { return Err(format!("expected a list of booleans, got {}", v.type_name())) };
    if bits.len() > 32 {
        return Err("more than 32 bits".to_owned());
    }
    let mut out = 0_u32;
    for (i, bit) in bits.iter().enumerate() {
        out |= u32::from(boolean(bit)?) << i;
    }
    Ok(Value::Int(out.cast_signed()))
}

fn to_number(s: &str) -> Outcome {
    let s = s.trim();
    s.parse().map(Value::Int).or_else(|_| s.parse().map(Value::Float)).map_err(|_| format!("'{s}' is not a number"))
}

fn concatenate(a: &Value, b: &Value) -> Outcome {
    let out = format!("{a}{b}");
    if out.len() > MAX_TEXT_BYTES {
        Err(format!("a string of more than {MAX_TEXT_BYTES} bytes"))
    } else {
        Ok(Value::Str(out))
    }
}

fn slice(s: &str, from: &Value, n: usize) -> Outcome {
    let from = index(from, s.chars().count().max(1))?;
    Ok(Value::Str(s.chars().skip(from).take(n).collect()))
}

fn find(s: &Value, target: &Value, from: &Value) -> Outcome {
    let (s, target, from) = (text(s)?, text(target)?, index(from, MAX_TEXT_BYTES)?);
    let Some((start, _)) = s.char_indices().nth(from) else { return Ok(Value::Int(-1)) };
    let found = s.get(start..).and_then(|t| t.find(target).map(|n| t.get(..n).map_or(0, |h| h.chars().count())));
    Ok(Value::Int(found.and_then(|n| i32::try_from(n + from).ok()).unwrap_or(-1)))
}
