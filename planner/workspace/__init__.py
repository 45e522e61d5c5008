"""Workspace maps of a rig, in slices and volumes, as numbers and as images."""
