"""Planning of position and orientation together, for scenes with rotation limits."""
