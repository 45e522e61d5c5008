"""Compiled geometry shared by searches and proofs.

Importing compiles nothing: each kernel is compiled at its first call and kept in the user's cache.
"""
