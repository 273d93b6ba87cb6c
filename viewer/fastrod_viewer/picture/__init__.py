"""The robot as batches of instances on a canvas, and what its colours mean."""
