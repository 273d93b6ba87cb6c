"""Experiments on a prototype: calibration, excitation, the whole loop."""
