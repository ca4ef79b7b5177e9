"""Ways of driving to the target, one folder each: estimate, estimator and laws."""
