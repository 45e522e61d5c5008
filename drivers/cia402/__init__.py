"""CANopen CiA 402 drives in cyclic synchronous position mode."""

import logging

# Log messages of canopen never go to the terminal by default.
logging.getLogger("canopen").addHandler(logging.NullHandler())
