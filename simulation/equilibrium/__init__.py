"""Compiled search for the pose at which a platform on elastic cables hangs still."""
