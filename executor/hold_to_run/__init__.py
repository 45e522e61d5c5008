"""Jogging by hold-to-run: the robot moves only as long as somebody keeps a control held.

From the control to the drives: `presses` (who holds what, since when), `line` (a straight line,
proved piece by piece ahead of the platform), `loop` (follows what is proved, as long as it is held,
in the real-time process) and `session` (all of it, from enabling to the ordered end). `cables`
moves one winch in place of the platform: its loop reads itself who holds what.
"""
