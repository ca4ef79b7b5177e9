"""Perception: from frames to the same features seen in three views."""
