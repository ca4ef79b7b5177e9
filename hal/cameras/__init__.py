"""Camera models, calibration files, and cameras that capture."""
