"""The run folder: records of a run, and results computed from them."""
