"""A quadruped with a soft neck."""
