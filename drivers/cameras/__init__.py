"""Cameras and recorded images: live devices, folders, videos, and image output."""
