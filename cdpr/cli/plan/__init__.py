"""The verbs of panel "Plan"; each is imported when it is called."""
