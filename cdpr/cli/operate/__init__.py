"""The verbs of the panel "Operate"; each is imported when it is called."""
