"""The verbs of panel "Operate"; each is imported when it is called."""
