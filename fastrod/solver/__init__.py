"""Solvers from inputs to equilibrium: the boundary solver, cold starts, responses, and batches put
together, on the CPU or a GPU."""
