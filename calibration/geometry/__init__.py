"""Calibrates the rig's geometry: outlets, anchors, drums and cable offsets."""
