"""The recommended planner: a first path at once, then better ones until the budget is spent."""
