"""A Pioneer without the robot: its firmware, drive and faults behind a serial line or TCP."""
