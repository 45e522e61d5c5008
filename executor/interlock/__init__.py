"""Motion interlock: the fault latch, the homing reference, locks against other programs."""
