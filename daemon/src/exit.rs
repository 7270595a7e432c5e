//! Exit codes, the same for every subcommand.

/// Why the program ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// 0: done.
    Done,
    /// 1: completed with a negative result: not converged, or a plan or request was refused.
    NotConverged,
    /// 2: the command line is wrong.
    Usage,
    /// 3: a file, an image, a selection or the configuration is wrong.
    Input,
    /// 4: a connection failed or was lost: robot, shared memory, another process.
    Link,
    /// 5: a fault is latched.
    Fault,
}

impl Exit {
    /// The process exit code.
    pub fn code(self) -> u8 {
        match self {
            Exit::Done => 0,
            Exit::NotConverged => 1,
            Exit::Usage => 2,
            Exit::Input => 3,
            Exit::Link => 4,
            Exit::Fault => 5,
        }
    }
}

/// A failure of a subcommand: the exit code and a message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Failure {
    /// The exit code.
    pub exit: Exit,
    /// What is wrong, with file, key or value, and what to do.
    pub message: String,
}

impl Failure {
    /// A wrong input or configuration.
    pub fn input(message: impl Into<String>) -> Self {
        Self { exit: Exit::Input, message: message.into() }
    }

    /// A failed connection to another process or to the robot.
    pub fn link(message: impl Into<String>) -> Self {
        Self { exit: Exit::Link, message: message.into() }
    }

    /// A latched fault.
    pub fn fault(message: impl Into<String>) -> Self {
        Self { exit: Exit::Fault, message: message.into() }
    }

    /// A negative result.
    pub fn refused(message: impl Into<String>) -> Self {
        Self { exit: Exit::NotConverged, message: message.into() }
    }
}

impl std::fmt::Display for Failure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for Failure {}
