"""The closed loop, room by room: replay a log, look at the residual, fit, name what is missing, report."""
