"""The real-time process: scheduling, clock, and memory shared with its supervisor."""
