"""Calibration targets: what they look like, where their points are, and how they are printed."""
