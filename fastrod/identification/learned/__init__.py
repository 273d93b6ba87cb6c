"""Models learned from a residual that no library effect explains: learned from a residual, and kept apart."""
