"""ODrives that speak CANSimple, as one group: no SYNC, a watchdog, a brake on every winch."""
