"""The shared model of a cable-driven parallel robot: files, kinematics, statics, and the command line."""
