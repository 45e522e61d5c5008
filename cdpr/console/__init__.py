"""The operator's console: a page that shows the robot live, and with which it is operated.

A client of the command socket and of the public API in a process of its own: what moves is started
as a verb of the command line, and goes on whatever becomes of the console.
"""
