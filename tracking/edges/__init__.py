"""Compiled fits to the pixels beside the edges of tags."""
