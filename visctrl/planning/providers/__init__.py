"""Obstacle providers: what tells a controller of what stands in the way."""

OBSTACLES = {"listed": "listed:Listed", "sonar": "sonar:Sonar"}
