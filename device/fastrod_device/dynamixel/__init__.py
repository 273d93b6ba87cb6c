"""Dynamixel servos on a serial line."""
