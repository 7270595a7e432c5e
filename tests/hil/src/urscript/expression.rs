//! Parser of expressions. Precedence, lowest first: `or`, `xor`, `and`, `not`, comparison, sum, product, sign, index
//! and call.

use super::ast::{Argument, BinaryOp, Expr, ExprKind, UnaryOp};
use super::error::ScriptError;
use super::lexer::Token;
use super::parser::Parser;
use super::value::Value;

/// Height of an expression's tree; a chain of operators adds one level per operator.
const MAX_DEPTH: u32 = 200;
/// Elements of a literal list.
const MAX_ELEMENTS: usize = 10_000;

fn node(kind: ExprKind, line: u32, below: u32) -> Result<Expr, ScriptError> {
    if below >= MAX_DEPTH {
        return Err(ScriptError::new(line, format!("expression with more than {MAX_DEPTH} operators in a chain")));
    }
    Ok(Expr { kind, line, depth: below + 1 })
}

fn deepest<'e>(items: impl IntoIterator<Item = &'e Expr>) -> u32 {
    items.into_iter().map(|e| e.depth).max().unwrap_or(0)
}

fn pair(make: impl FnOnce(Box<Expr>, Box<Expr>) -> ExprKind, l: Expr, r: Expr, line: u32) -> Result<Expr, ScriptError> {
    let below = l.depth.max(r.depth);
    node(make(Box::new(l), Box::new(r)), line, below)
}

impl Parser<'_> {
    pub(crate) fn expression(&mut self) -> Result<Expr, ScriptError> {
        self.deeper()?;
        let mut left = self.xor()?;
        loop {
            let line = self.line();
            if !self.take_word("or") {
                break;
            }
            let right = self.xor()?;
            left = pair(ExprKind::Or, left, right, line)?;
        }
        self.nesting -= 1;
        Ok(left)
    }

    fn xor(&mut self) -> Result<Expr, ScriptError> {
        let mut left = self.and()?;
        loop {
            let line = self.line();
            if !self.take_word("xor") {
                return Ok(left);
            }
            let right = self.and()?;
            left = pair(|l, r| ExprKind::Binary(BinaryOp::Xor, l, r), left, right, line)?;
        }
    }

    fn and(&mut self) -> Result<Expr, ScriptError> {
        let mut left = self.not()?;
        loop {
            let line = self.line();
            if !self.take_word("and") {
                return Ok(left);
            }
            let right = self.not()?;
            left = pair(ExprKind::And, left, right, line)?;
        }
    }

    fn not(&mut self) -> Result<Expr, ScriptError> {
        let line = self.line();
        if !self.take_word("not") {
            return self.comparison();
        }
        self.deeper()?;
        let inner = self.not()?;
        self.nesting -= 1;
        let below = inner.depth;
        node(ExprKind::Unary(UnaryOp::Not, Box::new(inner)), line, below)
    }

    fn operator(&mut self, table: &[(&str, BinaryOp)]) -> Option<BinaryOp> {
        table.iter().find(|(s, _)| self.take_symbol(s)).map(|(_, op)| *op)
    }

    fn comparison(&mut self) -> Result<Expr, ScriptError> {
        const OPS: [(&str, BinaryOp); 6] = [
            ("==", BinaryOp::Eq),
            ("!=", BinaryOp::Ne),
            ("<=", BinaryOp::Le),
            (">=", BinaryOp::Ge),
            ("<", BinaryOp::Lt),
            (">", BinaryOp::Gt),
        ];
        let left = self.sum()?;
        let line = self.line();
        let Some(op) = self.operator(&OPS) else { return Ok(left) };
        let right = self.sum()?;
        pair(|l, r| ExprKind::Binary(op, l, r), left, right, line)
    }

    fn sum(&mut self) -> Result<Expr, ScriptError> {
        let mut left = self.product()?;
        loop {
            let line = self.line();
            let Some(op) = self.operator(&[("+", BinaryOp::Add), ("-", BinaryOp::Sub)]) else { return Ok(left) };
            let right = self.product()?;
            left = pair(|l, r| ExprKind::Binary(op, l, r), left, right, line)?;
        }
    }

    fn product(&mut self) -> Result<Expr, ScriptError> {
        let mut left = self.sign()?;
        loop {
            let line = self.line();
            let Some(op) = self.operator(&[("*", BinaryOp::Mul), ("/", BinaryOp::Div), ("%", BinaryOp::Mod)]) else {
                return Ok(left);
            };
            let right = self.sign()?;
            left = pair(|l, r| ExprKind::Binary(op, l, r), left, right, line)?;
        }
    }

    fn sign(&mut self) -> Result<Expr, ScriptError> {
        let line = self.line();
        let op = if self.take_symbol("-") {
            UnaryOp::Neg
        } else if self.take_symbol("+") {
            UnaryOp::Plus
        } else {
            return self.postfix();
        };
        self.deeper()?;
        let inner = self.sign()?;
        self.nesting -= 1;
        let below = inner.depth;
        node(ExprKind::Unary(op, Box::new(inner)), line, below)
    }

    /// Parses elements `[...]`, members `.name` and remote calls `.name(...)` after a value.
    fn postfix(&mut self) -> Result<Expr, ScriptError> {
        let mut base = self.primary()?;
        loop {
            let line = base.line;
            let mut path = Vec::new();
            let mut method = None;
            loop {
                if self.take_symbol("[") {
                    let items = self.items("]")?;
                    if items.is_empty() {
                        return Err(ScriptError::new(line, "an index is missing between '[' and ']'"));
                    }
                    path.extend(items);
                } else if self.take_symbol(".") {
                    let name = self.identifier("a member's name")?;
                    if self.take_symbol("(") {
                        method = Some((name, self.arguments()?));
                        break;
                    }
                    path.push(node(ExprKind::Literal(Value::Str(name)), line, 0)?);
                } else {
                    break;
                }
            }
            if !path.is_empty() {
                let below = base.depth.max(deepest(&path));
                base = node(ExprKind::Index(Box::new(base), path), line, below)?;
            }
            let Some((name, arguments)) = method else { return Ok(base) };
            let below = base.depth.max(deepest(arguments.iter().map(|a| &a.value)));
            base = node(ExprKind::Method(Box::new(base), name, arguments), line, below)?;
        }
    }

    /// Parses expressions separated by commas, and the closing bracket.
    fn items(&mut self, close: &str) -> Result<Vec<Expr>, ScriptError> {
        let mut out = Vec::new();
        while !self.is_symbol(close) {
            if out.len() == MAX_ELEMENTS {
                return Err(ScriptError::new(self.line(), format!("more than {MAX_ELEMENTS} elements")));
            }
            out.push(self.expression()?);
            if !self.take_symbol(",") {
                break;
            }
        }
        self.expect_symbol(close)?;
        Ok(out)
    }

    fn primary(&mut self) -> Result<Expr, ScriptError> {
        // A value may follow on a later line.
        while matches!(self.peek(), Some(Token::Newline)) {
            self.advance();
        }
        let line = self.line();
        let literal = |value| node(ExprKind::Literal(value), line, 0);
        match self.peek() {
            Some(Token::Int(i)) => {
                self.advance();
                literal(Value::Int(*i))
            }
            Some(Token::Float(x)) => {
                self.advance();
                literal(Value::Float(*x))
            }
            Some(Token::Text(s)) => {
                self.advance();
                literal(Value::Str(s.clone()))
            }
            Some(Token::Symbol("(")) => {
                self.advance();
                let inner = self.expression()?;
                self.expect_symbol(")")?;
                Ok(inner)
            }
            Some(Token::Symbol("[")) => {
                self.advance();
                let items = self.items("]")?;
                let below = deepest(&items);
                node(ExprKind::List(items), line, below)
            }
            Some(Token::Name(word)) => match word.as_str() {
                "True" | "False" => {
                    self.advance();
                    literal(Value::Bool(word == "True"))
                }
                "run" => {
                    self.advance();
                    let name = self.identifier("a thread's name")?;
                    self.expect_symbol("(")?;
                    self.expect_symbol(")")?;
                    node(ExprKind::Run(name), line, 0)
                }
                // `p[...]` with six elements is a pose; with one or two it indexes a variable named p.
                "p" if matches!(self.peek_second(), Some(Token::Symbol("["))) => {
                    self.advance();
                    self.advance();
                    let items = self.items("]")?;
                    let below = deepest(&items);
                    match items.len() {
                        6 => node(ExprKind::Pose(items), line, below),
                        1 | 2 => {
                            let name = node(ExprKind::Name("p".to_owned()), line, 0)?;
                            node(ExprKind::Index(Box::new(name), items), line, below.max(1))
                        }
                        n => Err(ScriptError::new(line, format!("a pose needs six numbers, got {n}"))),
                    }
                }
                _ => {
                    let name = self.identifier("a value")?;
                    if !self.take_symbol("(") {
                        return node(ExprKind::Name(name), line, 0);
                    }
                    let arguments = self.arguments()?;
                    let below = deepest(arguments.iter().map(|a| &a.value));
                    node(ExprKind::Call(name, arguments), line, below)
                }
            },
            _ => Err(self.expected("a value")),
        }
    }

    fn arguments(&mut self) -> Result<Vec<Argument>, ScriptError> {
        let mut out: Vec<Argument> = Vec::new();
        while !self.is_symbol(")") {
            let name = match (self.peek(), self.peek_second()) {
                (Some(Token::Name(n)), Some(Token::Symbol("="))) => {
                    self.advance();
                    self.advance();
                    Some(n.clone())
                }
                _ => None,
            };
            if name.is_none() && out.iter().any(|a| a.name.is_some()) {
                return Err(self.expected("a named argument after a named argument"));
            }
            if out.len() == 64 {
                return Err(ScriptError::new(self.line(), "more than 64 arguments"));
            }
            out.push(Argument { name, value: self.expression()? });
            if !self.take_symbol(",") {
                break;
            }
        }
        self.expect_symbol(")")?;
        Ok(out)
    }
}
