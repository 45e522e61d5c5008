"""Compiled proofs that the cables can hold the platform all along an edge."""
