"""The rod of curvature modes, at rest or in motion: LANES robots side by side, base to tip and back."""
