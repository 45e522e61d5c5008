"""A rig to rehearse on: plant, simulated CiA 402 drives, fault bus, synthetic camera."""
