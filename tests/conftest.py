"""What all tests share: examples that are the same every time, and no deadline in wall time."""

from hypothesis import settings

settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")
