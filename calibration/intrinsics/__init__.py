"""Calibrates a camera: focal length, principal point and distortion."""
