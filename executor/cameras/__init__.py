"""Cameras during a run, each in a process of its own."""
