"""A robot: segments, tendons and their routing, its file, and both as arrays for the kernels."""
