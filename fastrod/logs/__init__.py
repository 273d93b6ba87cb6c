"""Logs of a robot's motion, their recording, and the link to a robot, real or simulated."""
