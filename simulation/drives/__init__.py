"""Simulated drives: as unkind as CiA 301 and CiA 402 allow, built from EDS files."""
