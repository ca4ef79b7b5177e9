"""A run as a video: the camera image with its tracks, and the robot from above."""
