"""Robust estimation: M-estimators, least squares and small linear algebra."""
