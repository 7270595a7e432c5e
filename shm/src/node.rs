//! The one iceoryx2 node of a process.

use crate::{Names, ShmError, private};
use iceoryx2::prelude::*;

/// The service variant everything here uses: between processes, ports not shared between threads.
pub type Ipc = ipc::Service;

/// A process's node together with the names it was made with. `Send`: make it in `main`, move it where ports are created.
///
/// Ports (publisher, subscriber) are not `Send`: create them on the thread that uses them.
#[derive(Debug)]
pub struct ShmNode {
    node: Node<Ipc>,
    names: Names,
}

/// Creates the process's node. Also makes and checks the root folder.
///
/// `role` becomes the node's name as tools show it. Signals stay the caller's: iceoryx2 installs no handler.
pub fn create_node(names: &Names, role: &str) -> Result<ShmNode, ShmError> {
    create_node_with(names, role, false)
}

/// As [`create_node`], accepting a root folder that others may write when `allow_insecure`.
pub fn create_node_with(names: &Names, role: &str, allow_insecure: bool) -> Result<ShmNode, ShmError> {
    // iceoryx2 logs to stderr, and warns that it found no configuration file: by design there is none.
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

    /// Number of the node, as its files are called.
    pub(crate) fn number(&self) -> String {
        self.node.id().value().to_string()
    }

    /// Removes what processes that died without saying goodbye left behind. Takes milliseconds: never on a real-time thread.
    ///
    /// A supervisor calls it about once a second; without it a killed publisher keeps its place in the service.
    pub fn clean_up(&self) {
        let _ = self.node.try_cleanup_dead_nodes();
    }
}
