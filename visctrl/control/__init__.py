"""Controllers: from geometry to a velocity."""
