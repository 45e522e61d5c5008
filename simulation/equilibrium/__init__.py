"""Compiled search for the equilibrium of a platform on elastic cables."""
