"""The verbs of `cdpr calibrate`; each is imported when it is called."""
