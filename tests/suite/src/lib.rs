//! End-to-end tests of graspd against third-party clients, and the tests of the source layout.
