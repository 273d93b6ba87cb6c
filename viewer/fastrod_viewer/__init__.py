"""The browser: 3D view, teleoperation and replay, on viser."""
