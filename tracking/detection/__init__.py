"""Finds and decodes tags in an image."""
