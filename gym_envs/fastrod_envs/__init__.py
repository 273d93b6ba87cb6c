"""Vectorised Gymnasium environments over one Simulator: N robots are N environments."""
