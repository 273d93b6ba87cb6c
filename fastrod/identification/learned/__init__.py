"""What no library has: learned from a residual, and kept apart."""
