"""The process that keeps the cycle: scheduling, clock, and memory shared with its supervisor."""
