"""A synthetic camera: renders what a camera would see of the simulated rig."""
