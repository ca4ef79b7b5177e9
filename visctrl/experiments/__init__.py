"""Experiments: many runs, what is published about them, and how ours compare."""
