"""Simulated drives: as strict as CiA 301 and CiA 402 allow, built from EDS files."""
