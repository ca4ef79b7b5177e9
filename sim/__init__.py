"""The simulated world: rooms, robot bodies, rendered cameras, and the backend made of them.

The world is described in the target's frame (x right, y forward, z up); PyBullet sees REP-103
axes. Importing this package does not import PyBullet.
"""
