//! Everything graspd computes before the arm moves.
