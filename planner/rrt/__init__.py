"""The paper's planner, compiled whole: Algorithms 1 to 3, their readings, and the goal bias.

Nothing is compiled on import; every kernel is when first called, and is kept in the user's cache.
"""
