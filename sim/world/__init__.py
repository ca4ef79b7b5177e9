"""The room, the robot's body and its physics."""
