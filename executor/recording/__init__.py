"""The run folder: what a run writes, and what is computed from it."""
