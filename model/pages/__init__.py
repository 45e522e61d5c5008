"""The one style of every HTML page: runs, calibrations, workspace maps, the paper's evaluation."""
