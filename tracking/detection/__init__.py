"""Detects and decodes tags in an image."""
