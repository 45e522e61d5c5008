"""The paper's planner, fully compiled: Algorithms 1 to 3, their readings, and the goal bias.

Importing compiles nothing; each kernel is compiled at its first call and kept in the user's cache.
"""
