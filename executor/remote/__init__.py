"""Other programs' access to a run: its status, and the operator's requests."""
