"""Drives on CAN: the bus, their objects, their configuration and faults."""
