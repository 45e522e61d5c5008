"""Finds where a camera is, from surveyed tags or from poses that the robot measured."""
