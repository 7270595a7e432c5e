//! graspd's contract with other processes.
