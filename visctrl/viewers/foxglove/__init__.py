"""A run in the Foxglove app, live or as an MCAP file."""
