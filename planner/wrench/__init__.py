"""Compiled proofs of wrench feasibility all along an edge."""
