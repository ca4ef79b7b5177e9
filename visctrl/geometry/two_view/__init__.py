"""Two views: essential and fundamental matrices, planar motion, and their robust estimation."""
