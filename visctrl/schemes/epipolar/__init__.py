"""Sliding-mode control on the epipoles of three views (chapter 2 of the source)."""
