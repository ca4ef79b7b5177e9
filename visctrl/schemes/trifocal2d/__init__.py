"""Pseudo-inverse control on the 2D trifocal tensor of planar motion, for comparison."""
