//! The wiring of the daemon: configuration, threads, sockets, commands.
