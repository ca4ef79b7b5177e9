"""The published tables and figures, made again: one file a chapter of the source."""
