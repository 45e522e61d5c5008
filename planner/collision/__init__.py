"""Compiled edge checks against obstacles and the robot's own parts, exact over the whole edge."""
