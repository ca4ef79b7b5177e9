"""Pictures of the room through a central camera model."""
