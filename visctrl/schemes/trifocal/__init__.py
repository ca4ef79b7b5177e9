"""Sliding-mode control on the 1D trifocal tensor (chapter 3 of the source)."""
