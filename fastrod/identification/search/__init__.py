"""Fits: base parameters, candidates, and which of them the held-out blocks confirm."""
