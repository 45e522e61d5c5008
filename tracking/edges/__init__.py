"""Compiled passes over the pixels beside the edges of tags."""
