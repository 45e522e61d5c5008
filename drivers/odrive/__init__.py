"""A group of ODrives with CANSimple: no SYNC, a watchdog, a brake on every winch."""
