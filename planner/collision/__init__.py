"""Compiled edge checks against obstacles and the robot itself, exact over the whole edge."""
