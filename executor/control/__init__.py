"""The control cycle: set-points to the drives, and reactions to their replies."""
