//! XML-RPC: handles of `rpc_factory`, and the encoding of calls and responses.
//!
//! Types: integer `int`, float `double`, boolean, string, list `array`, struct `struct`; a pose is a struct of x, y, z,
//! rx, ry and rz, as on the controller.

use super::arithmetic::{Outcome, bounded};
use super::host::{Host, Remote};
use super::value::Value;
use super::wait::{Flow, Wait};
use roxmltree::{Document, Node};
use std::fmt::Write;

/// Members of a pose in a call.
const POSE_MEMBERS: [&str; 6] = ["x", "y", "z", "rx", "ry", "rz"];
/// Nesting depth of a response's values.
const MAX_DEPTH: usize = 8;

/// `rpc_factory(type, url)`.
pub(crate) fn factory(kind: &str, url: &str) -> Outcome {
    if kind != "xmlrpc" {
        return Err(format!("rpc_factory: type '{kind}' is not supported, only 'xmlrpc'"));
    }
    if !url.starts_with("http://") {
        return Err(format!("rpc_factory: '{url}' is not an http:// URL"));
    }
    Ok(Value::Rpc(url.to_owned()))
}

/// Begins `handle.method(arguments)`.
pub(crate) fn begin(handle: &Value, method: &str, arguments: &[Value], host: &mut dyn Host) -> Result<Wait, String> {
    let Value::Rpc(url) = handle else { return Err(format!("{} is not a handle of rpc_factory", handle.type_name())) };
    let mut body = format!("<?xml version=\"1.0\"?><methodCall><methodName>{method}</methodName><params>");
    for argument in arguments {
        body.push_str("<param>");
        encode(argument, &mut body).map_err(|e| format!("remote call '{method}': {e}"))?;
        body.push_str("</param>");
    }
    body.push_str("</params></methodCall>");
    host.rpc_begin(url, &body).map(Wait::Remote).map_err(|e| e.to_string())
}

/// Continues a call, once in each control step.
pub(crate) fn resume(call: u32, host: &mut dyn Host) -> Outcome<Flow> {
    match host.rpc_poll(call) {
        Remote::Pending => Ok(Flow::Wait(Wait::Remote(call))),
        Remote::Failed(reason) => Err(format!("remote call failed: {reason}")),
        Remote::Response(body) => response(&String::from_utf8_lossy(&body))
            .and_then(bounded)
            .map(Flow::Value)
            .map_err(|e| format!("remote call: {e}")),
    }
}

fn encode(value: &Value, out: &mut String) -> Result<(), String> {
    out.push_str("<value>");
    match value {
        Value::Int(i) => _ = write!(out, "<int>{i}</int>"),
        Value::Float(x) => _ = write!(out, "<double>{x}</double>"),
        Value::Bool(b) => _ = write!(out, "<boolean>{}</boolean>", u8::from(*b)),
        Value::Str(s) => _ = write!(out, "<string>{}</string>", escape(s)),
        Value::Pose(p) => {
            out.push_str("<struct>");
            for (name, x) in POSE_MEMBERS.iter().zip(p) {
                encode_member(name, &Value::Float(*x), out)?;
            }
            out.push_str("</struct>");
        }
        Value::Struct(members) => {
            out.push_str("<struct>");
            for (name, member) in members {
                encode_member(name, member, out)?;
            }
            out.push_str("</struct>");
        }
        Value::List(items) => {
            out.push_str("<array><data>");
            for item in items {
                encode(item, out)?;
            }
            out.push_str("</data></array>");
        }
        Value::None | Value::Rpc(_) | Value::Thread(_) => {
            return Err(format!("{} cannot be an argument", value.type_name()));
        }
    }
    out.push_str("</value>");
    Ok(())
}

fn encode_member(name: &str, value: &Value, out: &mut String) -> Result<(), String> {
    let _ = write!(out, "<member><name>{}</name>", escape(name));
    encode(value, out)?;
    out.push_str("</member>");
    Ok(())
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

/// Value of a response.
fn response(text: &str) -> Outcome {
    let document = Document::parse(text).map_err(|e| format!("the response is not XML: {e}"))?;
    let root = document.root_element();
    if !root.has_tag_name("methodResponse") {
        return Err(format!("the response is <{}>, not <methodResponse>", root.tag_name().name()));
    }
    if let Some(fault) = child(root, "fault") {
        let value = child(fault, "value").map_or(Ok(Value::None), |v| decode(v, 0))?;
        return Err(format!("the server returned a fault: {value}"));
    }
    let value = child(root, "params").and_then(|p| child(p, "param")).and_then(|p| child(p, "value"));
    value.map_or(Ok(Value::None), |v| decode(v, 0))
}

fn child<'a>(node: Node<'a, 'a>, name: &str) -> Option<Node<'a, 'a>> {
    node.children().find(|c| c.has_tag_name(name))
}

/// Value of a `<value>` element.
fn decode(value: Node<'_, '_>, depth: usize) -> Outcome {
    if depth > MAX_DEPTH {
        return Err(format!("values nested more than {MAX_DEPTH} deep"));
    }
    let Some(inner) = value.children().find(Node::is_element) else {
        return Ok(Value::Str(value.text().unwrap_or("").to_owned()));
    };
    let text = inner.text().unwrap_or("");
    let wrong = || format!("'{text}' is not a valid <{}>", inner.tag_name().name());
    Ok(match inner.tag_name().name() {
        "i4" | "int" | "i8" => Value::Int(text.trim().parse().map_err(|_| wrong())?),
        "double" => Value::Float(text.trim().parse().map_err(|_| wrong())?),
        "boolean" => match text.trim() {
            "1" | "true" => Value::Bool(true),
            "0" | "false" => Value::Bool(false),
            _ => return Err(wrong()),
        },
        "string" | "base64" | "dateTime.iso8601" => Value::Str(text.to_owned()),
        "nil" => Value::None,
        "array" => {
            let data = child(inner, "data");
            let items = data.into_iter().flat_map(|d| d.children().filter(|c| c.has_tag_name("value")));
            Value::List(items.map(|v| decode(v, depth + 1)).collect::<Result<_, _>>()?)
        }
        "struct" => {
            let mut members = Vec::new();
            for m in inner.children().filter(|c| c.has_tag_name("member")) {
                let name = child(m, "name").and_then(|n| n.text()).unwrap_or("").trim().to_owned();
                members.push((name, child(m, "value").map_or(Ok(Value::None), |v| decode(v, depth + 1))?));
            }
            pose(&members).unwrap_or(Value::Struct(members))
        }
        other => return Err(format!("type <{other}> is not supported")),
    })
}

/// The pose of a struct with exactly the members of a pose.
fn pose(members: &[(String, Value)]) -> Option<Value> {
    let mut p = [0.0; 6];
    for (slot, name) in p.iter_mut().zip(POSE_MEMBERS) {
        *slot = members.iter().find(|(n, _)| n == name)?.1.as_f64()?;
    }
    (members.len() == 6).then_some(Value::Pose(p))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_survive_encoding_and_decoding() {
        for value in [
            Value::Int(-7),
            Value::Float(0.125),
            Value::Bool(true),
            Value::Str("a < b & c".to_owned()),
            Value::Pose([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]),
            Value::List(vec![Value::Int(1), Value::Str(String::new())]),
            Value::Struct(vec![("a".to_owned(), Value::Int(1)), ("b".to_owned(), Value::floats(&[1.5]))]),
        ] {
            let mut text = String::from("<methodResponse><params><param>");
            encode(&value, &mut text).unwrap();
            text.push_str("</param></params></methodResponse>");
            assert_eq!(response(&text).unwrap(), value);
        }
    }

    #[test]
    fn faults_and_damaged_responses_are_errors() {
        let fault = "<methodResponse><fault><value><struct><member><name>faultString</name><value>no camera</value></member></struct></value></fault></methodResponse>";
        assert!(response(fault).unwrap_err().contains("no camera"));
        for bad in [
            "",
            "<html/>",
            "<methodResponse><params><param><value><int>x</int></value></param></params></methodResponse>",
        ] {
            assert!(response(bad).is_err(), "{bad}");
        }
    }
}
