//! What can go wrong when a topic is created, opened or used; each error says what was expected and what to do.

use crate::names::NamesError;

/// Failure of the shared-memory layer.
#[derive(Debug, thiserror::Error)]
pub enum ShmError {
    /// Root folder, prefix or cell name unusable.
    #[error(transparent)]
    Names(#[from] NamesError),
    /// The process's node could not be created.
    #[error(
        "cannot create an iceoryx2 node under {root} (prefix {prefix}): {reason}. Check that the folder belongs to the user that \
         runs graspd, that /dev/shm has room, and that every graspd process runs as the same user"
    )]
    Node {
        /// Root folder in use.
        root: String,
        /// Prefix in use.
        prefix: String,
        /// iceoryx2's reason.
        reason: String,
    },
    /// The service exists with another layout or other quality of service, or cannot be created.
    #[error(
        "cannot open service '{service}': {reason}. Expected {expected}. A process that disagrees opened it first (an older camera \
         driver?): stop every publisher and subscriber of this cell, update them, start again; shm/LAYOUT.md has the layout"
    )]
    Service {
        /// Service name.
        service: String,
        /// iceoryx2's reason.
        reason: String,
        /// What this build expects: types, sizes, alignments, quality of service.
        expected: String,
    },
    /// A publisher or subscriber could not be created.
    #[error(
        "cannot create a {port} on '{service}': {reason}. The service allows {limit} of them; another one is running (or died less \
         than a second ago)"
    )]
    Port {
        /// `publisher` or `subscriber`.
        port: &'static str,
        /// Service name.
        service: String,
        /// iceoryx2's reason.
        reason: String,
        /// Largest number of such ports.
        limit: usize,
    },
    /// A sample could not be loaned.
    #[error("cannot loan a frame of {bytes} bytes: {reason}")]
    Loan {
        /// Bytes asked for.
        bytes: usize,
        /// iceoryx2's reason.
        reason: String,
    },
    /// A sample could not be sent.
    #[error("cannot send a frame: {reason}")]
    Send {
        /// iceoryx2's reason.
        reason: String,
    },
    /// The frame's own description is not possible.
    #[error("frame geometry refused: {0}")]
    Geometry(crate::frame::Reject),
}
