"""The shared model of a cable robot: files, kinematics, statics, and the command line."""
