"""Compiled geometry that the searches and proofs share.

Nothing is compiled on import: every kernel is compiled when first called, and kept in the user's
cache.
"""
