"""Jogging by hold-to-run: the robot moves only while a control is held.

From the control to the drives: `presses` (held controls), `line` (a straight line, checked piece by
piece ahead of the platform), `loop` (follows the checked line while the control is held, in the
real-time process) and `session` (the whole session, from enabling to the ordered end). `cables`
moves one winch instead of the platform: its loop reads the presses itself.
"""
