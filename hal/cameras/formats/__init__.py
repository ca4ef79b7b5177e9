"""Calibration files, one format a file.

Each module has ``recognises(data)``, ``read(data, where, cam)`` and ``write(camera)``; all of the
formats but COLMAP's put the centre of the first pixel at (0, 0), as this package does.
"""
