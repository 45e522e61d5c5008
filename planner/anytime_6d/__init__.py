"""Planning of position and orientation together, for scenes that allow the platform to turn."""
