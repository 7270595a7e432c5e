//! The one iceoryx2 node of a process.

use crate::{Names, ShmError, private};
use iceoryx2::prelude::*;

/// The service variant in use: between processes, with ports that are not shared between threads.
pub type Ipc = ipc::Service;

/// A process's node, with the names it was created with.
///
/// It is `Send`: create it in `main` and move it to where ports are created. Ports (publisher, subscriber) are not
/// `Send`: create them on the thread that uses them.
#[derive(Debug)]
pub struct ShmNode {
    node: Node<Ipc>,
    names: Names,
}

/// Creates the process's node, and creates and checks the root folder.
///
/// `role` becomes the node's name in tools. iceoryx2 installs no signal handler.
///
/// # Errors
/// The root folder or the node cannot be created, or the root folder is not safe.
pub fn create_node(names: &Names, role: &str) -> Result<ShmNode, ShmError> {
    create_node_with(names, role, false)
}

/// As [`create_node`]; with `allow_insecure` also in a root folder that others may write into.
///
/// # Errors
/// As [`create_node`].
pub fn create_node_with(names: &Names, role: &str, allow_insecure: bool) -> Result<ShmNode, ShmError> {
    // iceoryx2 would warn on stderr that there is no configuration file, which is intended.
    set_log_level_from_env_or(LogLevel::Fatal);
    names.ensure_root(allow_insecure)?;
    if !allow_insecure {
        private::management_segment(names)?;
    }
    let fail = |reason: String| ShmError::Node {
        root: names.root().display().to_string(),
        prefix: names.prefix().to_string(),
        reason,
    };
    let config = names.config()?;
    let name = NodeName::new(role).map_err(|e| fail(format!("node name '{role}': {e:?}")))?;
    let node = NodeBuilder::new()
        .name(&name)
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<Ipc>()
        .map_err(|e| fail(format!("{e:?}")))?;
    Ok(ShmNode { node, names: names.clone() })
}

impl ShmNode {
    /// iceoryx2's node.
    pub fn node(&self) -> &Node<Ipc> {
        &self.node
    }

    /// The names the node was created with.
    pub fn names(&self) -> &Names {
        &self.names
    }

    /// Number of the node, which the names of its files contain.
    pub(crate) fn number(&self) -> String {
        self.node.id().value().to_string()
    }

    /// Removes the nodes of processes that were killed. Takes milliseconds: never call it on a real-time thread.
    ///
    /// Call it about once a second. Without it a killed publisher counts against the service's limit for ever.
    pub fn clean_up(&self) {
        let _ = self.node.try_cleanup_dead_nodes();
    }
}
