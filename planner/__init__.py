"""Collision-free, feasible paths for a rig in a scene, and the independent check of a plan."""
