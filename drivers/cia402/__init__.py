"""CANopen CiA 402 drives in cyclic synchronous position mode."""

import logging

# What canopen says of its own goes where a program that uses it wants it, never to the terminal.
logging.getLogger("canopen").addHandler(logging.NullHandler())
