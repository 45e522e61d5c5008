"""Trajectories: from a verified plan to checked set-points."""
