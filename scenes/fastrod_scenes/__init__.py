"""Scenes: robots with their surroundings, and measured data of real robots brought into run logs."""
