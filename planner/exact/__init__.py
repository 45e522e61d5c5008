"""Exact compiled edge checks: one primitive a file, its plain NumPy definition beside it.

Nothing is compiled on import: every kernel is compiled when first called, and kept in the user's
cache.
"""
