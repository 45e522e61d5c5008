"""What forbids motion: the fault latch, a missing encoder reference, another program."""
