"""Shapes and distances between them."""
