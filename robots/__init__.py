"""Wheeled robots: their geometry, limits and camera mounts, and the unicycle they share."""

from visctrl.robots.model import Limits, Robot, load_robot, robot_names

__all__ = ["Limits", "Robot", "load_robot", "robot_names"]
