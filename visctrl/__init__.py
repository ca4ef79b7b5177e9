"""Visual control of wheeled mobile robots: drive to the pose of a target image."""

__version__ = "0.1.0"
