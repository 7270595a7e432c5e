//! Errors of creating, opening and using a topic; each states what was expected and what to do.

use crate::frame_error::FrameError;
use crate::names::NamesError;

/// An error of the shared-memory layer.
#[derive(Debug, thiserror::Error)]
pub enum ShmError {
    /// Root folder, prefix or cell name cannot be used.
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
    /// The service exists with another layout or quality of service, or cannot be created.
    #[error(
        "cannot open service '{service}': {reason}. Expected {expected}. Another process (an older camera driver?) created it with \
         other properties: stop every publisher and subscriber of this cell, update them, start again; shm/LAYOUT.md has the layout"
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
        "cannot create a {port} on '{service}': {reason}. The service allows {limit} of them, and they are in use: stop one, or wait \
         a second if it has just died"
    )]
    Port {
        /// `publisher` or `subscriber`.
        port: &'static str,
        /// Service name.
        service: String,
        /// iceoryx2's reason.
        reason: String,
        /// Number of such ports that the service allows.
        limit: usize,
    },
    /// A sample could not be loaned.
    #[error("cannot loan a frame of {bytes} bytes: {reason}")]
    Loan {
        /// Requested size, bytes.
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
    /// Size, stride and pixel format of a publisher do not fit together.
    #[error("the frame geometry is not possible: {0}")]
    Geometry(FrameError),
}
