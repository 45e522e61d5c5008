"""Pure safety decisions: which set-points may be sent, and when the rig must stop."""
