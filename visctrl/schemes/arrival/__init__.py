"""Arrival: is the picture here the target's, and how to bring it to coincide if it nearly is."""

ESTIMATORS = {"coincidence": "estimator:CoincidenceEstimator"}
CONTROLLERS = {"coincide": "law:Coincide"}
#: What drives the last decimetre where the scenario does not say.
ESTIMATOR, CONTROLLER = "coincidence", "coincide"
