"""The rod's equations, their exact derivatives, and the passes over a batch's chunks."""
