"""Calibration targets: their points, their detection, and prints of them."""
