"""Cameras from images: projection centre, and the whole central model."""
