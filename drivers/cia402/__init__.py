"""CANopen CiA 402 drives in cyclic synchronous position mode."""
