"""The cycle: what is sent to the drives, and what is done about what they reply."""
