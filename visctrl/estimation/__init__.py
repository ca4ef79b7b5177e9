"""Estimators: from features in three views to geometry with a covariance."""
