"""Maps of what a rig can do where: in slices and volumes, as numbers and as images."""
