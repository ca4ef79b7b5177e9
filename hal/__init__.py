"""What hardware looks like: cameras, bases, clocks, and the backends that bring them together."""
