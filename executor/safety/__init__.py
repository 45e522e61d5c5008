"""Pure decisions about safety: what may be sent, and what must stop the rig. No clock, no bus."""
