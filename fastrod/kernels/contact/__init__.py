"""Proximity, contacts of a rod, and their forces."""
