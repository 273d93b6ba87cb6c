"""The camera: its calibration, its marker, its pictures."""
