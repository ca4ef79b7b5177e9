"""Arrival: is the picture here the target's, and if not, what is left to drive."""
