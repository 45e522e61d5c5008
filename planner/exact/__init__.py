"""Exact compiled edge checks: one primitive a file, its plain NumPy definition beside it.

Nothing is compiled on import; `planner.exact.compilation.compile_all` does it at once, and else
every kernel is compiled when first called and kept in the user's cache.
"""
