"""Scenes in which a rod touches something: one a file."""
