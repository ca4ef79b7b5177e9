"""Turning on the spot until the target lies straight ahead, before a scheme takes over."""
