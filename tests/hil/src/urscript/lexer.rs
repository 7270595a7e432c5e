//! Lexer. Indentation has no meaning, nor have line ends within brackets.

use super::error::ScriptError;

/// Largest program: 1 MiB, twenty times the largest published driver script.
pub(crate) const MAX_SOURCE_BYTES: usize = 1 << 20;

#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Token {
    Name(String),
    Int(i32),
    Float(f64),
    Text(String),
    /// Operator or bracket.
    Symbol(&'static str),
    /// End of a logical line.
    Newline,
}

#[derive(Clone, Debug)]
pub(crate) struct Lexed {
    pub(crate) token: Token,
    pub(crate) line: u32,
}

const SYMBOLS: [&str; 20] =
    ["==", "!=", "<=", ">=", "(", ")", "[", "]", ",", ":", "=", "<", ">", "+", "-", "*", "/", "%", ".", ";"];

/// Splits a text into tokens; its first line has number `first_line`.
pub(crate) fn lex(text: &str, first_line: u32) -> Result<Vec<Lexed>, ScriptError> {
    if text.len() > MAX_SOURCE_BYTES {
        return Err(ScriptError::new(
            first_line,
            format!("the program has {} bytes, the maximum is {MAX_SOURCE_BYTES}", text.len()),
        ));
    }
    let mut out = Vec::new();
    let mut brackets = 0_usize;
    for (number, raw) in text.split('\n').enumerate() {
        let line = u32::try_from(number).unwrap_or(u32::MAX).saturating_add(first_line);
        let before = out.len();
        lex_line(raw, line, &mut brackets, &mut out)?;
        if out.len() > before && brackets == 0 {
            out.push(Lexed { token: Token::Newline, line });
        }
    }
    Ok(out)
}

fn lex_line(raw: &str, line: u32, brackets: &mut usize, out: &mut Vec<Lexed>) -> Result<(), ScriptError> {
    // PolyScope marks the program node of the following lines with `$ 12 "text"`, which is not a statement.
    if raw.trim_start().starts_with('$') {
        return Ok(());
    }
    let mut rest = raw;
    loop {
        rest = rest.trim_start_matches([' ', '\t', '\r']);
        let Some(first) = rest.chars().next() else { return Ok(()) };
        if first == '#' {
            return Ok(());
        }
        let (token, used) = if first.is_ascii_alphabetic() || first == '_' {
            let n = rest.find(|c: char| !(c.is_ascii_alphanumeric() || c == '_')).unwrap_or(rest.len());
            (Token::Name(rest[..n].to_owned()), n)
        } else if first.is_ascii_digit() || (first == '.' && rest[1..].starts_with(|c: char| c.is_ascii_digit())) {
            number(rest, line)?
        } else if first == '"' || first == '\'' {
            let body = &rest[1..];
            let Some(n) = body.find(first) else {
                return Err(ScriptError::new(line, "the string has no closing quote on its line"));
            };
            (Token::Text(body[..n].to_owned()), n + 2)
        } else if let Some(s) = SYMBOLS.iter().find(|s| rest.starts_with(**s)) {
            match *s {
                "(" | "[" => *brackets += 1,
                ")" | "]" => *brackets = brackets.saturating_sub(1),
                _ => {}
            }
            (Token::Symbol(s), s.len())
        } else if first == '\u{feff}' {
            return Err(ScriptError::new(line, "the text begins with a byte order mark; save it as UTF-8 without one"));
        } else {
            return Err(ScriptError::new(line, format!("unexpected character {first:?}")));
        };
        out.push(Lexed { token, line });
        rest = &rest[used..];
    }
}

fn number(rest: &str, line: u32) -> Result<(Token, usize), ScriptError> {
    let wrong = |text: &str| ScriptError::new(line, format!("'{text}' is not a number, or out of range"));
    let bytes = rest.as_bytes();
    if rest.starts_with("0x") || rest.starts_with("0X") {
        let n = 2 + bytes[2..].iter().take_while(|b| b.is_ascii_hexdigit()).count();
        let value = u32::from_str_radix(&rest[2..n], 16).map_err(|_| wrong(&rest[..n]))?;
        return Ok((Token::Int(value.cast_signed()), n));
    }
    let digits = |from: usize| bytes.iter().skip(from).take_while(|b| b.is_ascii_digit()).count();
    let mut n = digits(0);
    let mut real = false;
    if bytes.get(n) == Some(&b'.') {
        real = true;
        n += 1;
        n += digits(n);
    }
    if matches!(bytes.get(n), Some(b'e' | b'E')) {
        let sign = usize::from(matches!(bytes.get(n + 1), Some(b'+' | b'-')));
        let exponent = digits(n + 1 + sign);
        if exponent > 0 {
            real = true;
            n += 1 + sign + exponent;
        }
    }
    if matches!(bytes.get(n), Some(b) if b.is_ascii_alphabetic() || *b == b'_') {
        return Err(wrong(&rest[..=n]));
    }
    let text = &rest[..n];
    let token = if real {
        Token::Float(text.parse::<f64>().ok().filter(|x| x.is_finite()).ok_or_else(|| wrong(text))?)
    } else {
        Token::Int(text.parse().map_err(|_| wrong(text))?)
    };
    Ok((token, n))
}
