"""Sweeps: one scenario over a grid of settings, starts and seeds, on many processes."""
