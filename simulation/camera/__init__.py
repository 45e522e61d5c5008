"""A synthetic camera, which renders images of the simulated rig."""
