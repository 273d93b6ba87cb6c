"""Scenes with soft robots on a UR5 (`pip install fastrod[hosts]`)."""
