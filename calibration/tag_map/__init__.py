"""Finds where tags are from images that show several of them."""
