//! Parser of statements and functions. Expressions are parsed in `expression.rs`.

use super::ast::{Function, FunctionKind, Parameter, Scope, Stmt, StmtKind};
use super::error::ScriptError;
use super::lexer::{Lexed, Token};

/// Nesting depth of blocks and brackets: far above real scripts, far below the stack limit of a thread.
pub(crate) const MAX_NESTING: u32 = 48;

/// Words that cannot be names of variables or functions.
const KEYWORDS: [&str; 25] = [
    "def",
    "thread",
    "sec",
    "if",
    "elif",
    "else",
    "while",
    "end",
    "return",
    "break",
    "continue",
    "global",
    "local",
    "run",
    "kill",
    "join",
    "halt",
    "and",
    "or",
    "not",
    "xor",
    "True",
    "False",
    "enter_critical",
    "exit_critical",
];

pub(crate) struct Parser<'t> {
    tokens: &'t [Lexed],
    at: usize,
    pub(crate) nesting: u32,
    loops: u32,
}

/// Parses the statements of a text.
pub(crate) fn parse(tokens: &[Lexed]) -> Result<Vec<Stmt>, ScriptError> {
    let mut parser = Parser { tokens, at: 0, nesting: 0, loops: 0 };
    let body = parser.block(&[])?;
    Ok(body)
}

impl<'t> Parser<'t> {
    pub(crate) fn peek(&self) -> Option<&'t Token> {
        self.tokens.get(self.at).map(|l| &l.token)
    }

    pub(crate) fn peek_second(&self) -> Option<&'t Token> {
        self.tokens.get(self.at + 1).map(|l| &l.token)
    }

    pub(crate) fn line(&self) -> u32 {
        self.tokens.get(self.at).or(self.tokens.last()).map_or(1, |l| l.line)
    }

    pub(crate) fn advance(&mut self) {
        self.at += 1;
    }

    pub(crate) fn is_symbol(&self, symbol: &str) -> bool {
        matches!(self.peek(), Some(Token::Symbol(s)) if *s == symbol)
    }

    pub(crate) fn is_word(&self, word: &str) -> bool {
        matches!(self.peek(), Some(Token::Name(n)) if n == word)
    }

    pub(crate) fn take_symbol(&mut self, symbol: &str) -> bool {
        let is = self.is_symbol(symbol);
        self.at += usize::from(is);
        is
    }

    pub(crate) fn take_word(&mut self, word: &str) -> bool {
        let is = self.is_word(word);
        self.at += usize::from(is);
        is
    }

    pub(crate) fn expected(&self, what: &str) -> ScriptError {
        let found = match self.peek() {
            None => "the end of the text".to_owned(),
            Some(Token::Newline) => "the end of the line".to_owned(),
            Some(Token::Name(n)) => format!("'{n}'"),
            Some(Token::Int(i)) => format!("'{i}'"),
            Some(Token::Float(x)) => format!("'{x}'"),
            Some(Token::Text(_)) => "a string".to_owned(),
            Some(Token::Symbol(s)) => format!("'{s}'"),
        };
        ScriptError::new(self.line(), format!("syntax error: expected {what}, found {found}"))
    }

    pub(crate) fn expect_symbol(&mut self, symbol: &str) -> Result<(), ScriptError> {
        if self.take_symbol(symbol) { Ok(()) } else { Err(self.expected(&format!("'{symbol}'"))) }
    }

    /// Parses a name that is not a keyword.
    pub(crate) fn identifier(&mut self, what: &str) -> Result<String, ScriptError> {
        match self.peek() {
            Some(Token::Name(n)) if !KEYWORDS.contains(&n.as_str()) => {
                self.advance();
                Ok(n.clone())
            }
            _ => Err(self.expected(what)),
        }
    }

    pub(crate) fn deeper(&mut self) -> Result<(), ScriptError> {
        self.nesting += 1;
        if self.nesting > MAX_NESTING {
            return Err(ScriptError::new(self.line(), format!("nested more than {MAX_NESTING} deep")));
        }
        Ok(())
    }

    /// Parses statements up to one of the closing words (not consumed), or to the end of the text if there are none.
    ///
    /// A line may hold several statements: a name cannot continue an expression, so it begins the next statement.
    /// Programs in the field write `x = -0.2 show(x)`, and interpreter mode needs functions on one line.
    fn block(&mut self, closers: &[&str]) -> Result<Vec<Stmt>, ScriptError> {
        self.deeper()?;
        let opened = self.line();
        let mut out = Vec::new();
        loop {
            while matches!(self.peek(), Some(Token::Newline)) || self.is_symbol(";") {
                self.advance();
            }
            if self.peek().is_none() {
                if closers.is_empty() {
                    break;
                }
                return Err(ScriptError::new(opened, "this block has no 'end'"));
            }
            if closers.iter().any(|c| self.is_word(c)) {
                break;
            }
            out.push(self.statement()?);
            let ended = matches!(self.peek(), None | Some(Token::Newline | Token::Name(_))) || self.is_symbol(";");
            if !ended {
                return Err(self.expected("the end of the statement"));
            }
        }
        self.nesting -= 1;
        Ok(out)
    }

    fn statement(&mut self) -> Result<Stmt, ScriptError> {
        let line = self.line();
        let Some(Token::Name(word)) = self.peek() else { return Err(self.expected("a statement")) };
        let kind = match word.as_str() {
            "def" | "thread" | "sec" => StmtKind::Def(self.function()?),
            "if" => self.if_statement()?,
            "while" => {
                self.advance();
                let condition = self.expression()?;
                self.expect_symbol(":")?;
                self.loops += 1;
                let body = self.block(&["end"])?;
                self.loops -= 1;
                self.advance();
                StmtKind::While { condition, body }
            }
            "return" => {
                self.advance();
                let none =
                    matches!(self.peek(), None | Some(Token::Newline)) || self.is_word("end") || self.is_symbol(";");
                StmtKind::Return(if none { None } else { Some(self.expression()?) })
            }
            "break" | "continue" => {
                if self.loops == 0 {
                    return Err(ScriptError::new(line, format!("'{word}' outside a loop")));
                }
                self.advance();
                if word == "break" { StmtKind::Break } else { StmtKind::Continue }
            }
            "halt" => self.word(StmtKind::Halt),
            "enter_critical" => self.word(StmtKind::EnterCritical),
            "exit_critical" => self.word(StmtKind::ExitCritical),
            "kill" => {
                self.advance();
                StmtKind::Kill(self.expression()?)
            }
            "join" => {
                self.advance();
                StmtKind::Join(self.expression()?)
            }
            "global" | "local" => {
                let scope = if word == "global" { Scope::Global } else { Scope::Local };
                self.advance();
                let name = self.identifier("a variable's name")?;
                self.expect_symbol("=")?;
                StmtKind::Assign { scope, name, path: Vec::new(), value: self.expression()? }
            }
            _ => self.assignment_or_call()?,
        };
        Ok(Stmt { kind, line })
    }

    fn word(&mut self, kind: StmtKind) -> StmtKind {
        self.advance();
        kind
    }

    fn if_statement(&mut self) -> Result<StmtKind, ScriptError> {
        self.advance();
        let mut arms = Vec::new();
        let mut otherwise = Vec::new();
        loop {
            let condition = self.expression()?;
            self.expect_symbol(":")?;
            arms.push((condition, self.block(&["elif", "else", "end"])?));
            if self.take_word("elif") {
                continue;
            }
            if self.take_word("else") {
                self.expect_symbol(":")?;
                otherwise = self.block(&["end"])?;
            }
            self.advance();
            return Ok(StmtKind::If { arms, otherwise });
        }
    }

    fn function(&mut self) -> Result<Function, ScriptError> {
        let line = self.line();
        let kind = if self.is_word("def") {
            FunctionKind::Def
        } else if self.is_word("thread") {
            FunctionKind::Thread
        } else {
            FunctionKind::Sec
        };
        self.advance();
        let name = self.identifier("a function's name")?;
        self.expect_symbol("(")?;
        let mut parameters: Vec<Parameter> = Vec::new();
        while !self.is_symbol(")") {
            let at = self.line();
            let name = self.identifier("a parameter's name")?;
            if parameters.iter().any(|p| p.name == name) {
                return Err(ScriptError::new(at, format!("parameter '{name}' is named twice")));
            }
            let default = if self.take_symbol("=") { Some(self.expression()?) } else { None };
            parameters.push(Parameter { name, default });
            if !self.take_symbol(",") {
                break;
            }
        }
        self.expect_symbol(")")?;
        self.expect_symbol(":")?;
        if kind != FunctionKind::Def && !parameters.is_empty() {
            return Err(ScriptError::new(
                line,
                format!("'{name}' cannot take parameters: threads and sec programs have none"),
            ));
        }
        let loops = std::mem::take(&mut self.loops);
        let body = self.block(&["end"])?;
        self.loops = loops;
        self.advance();
        Ok(Function { kind, name, parameters, body, line })
    }

    fn assignment_or_call(&mut self) -> Result<StmtKind, ScriptError> {
        use super::ast::ExprKind;
        let expr = self.expression()?;
        if !self.take_symbol("=") {
            return match expr.kind {
                ExprKind::Call(..) | ExprKind::Method(..) | ExprKind::Run(_) => Ok(StmtKind::Expr(expr)),
                _ => Err(ScriptError::new(expr.line, "syntax error: a value is not a statement")),
            };
        }
        let (name, path) = match expr.kind {
            ExprKind::Name(name) => (name, Vec::new()),
            ExprKind::Index(base, path) => match base.kind {
                ExprKind::Name(name) => (name, path),
                _ => {
                    return Err(ScriptError::new(expr.line, "only an element or member of a variable can be assigned"));
                }
            },
            _ => return Err(ScriptError::new(expr.line, "only a variable can be assigned")),
        };
        Ok(StmtKind::Assign { scope: Scope::Free, name, path, value: self.expression()? })
    }
}
