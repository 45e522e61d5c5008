"""Cameras of a run, each in its own process."""
