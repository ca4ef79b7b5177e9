"""Turning on the spot until the target lies straight ahead, before a scheme takes over."""

ESTIMATORS = {"planar-motion": "estimator:PlanarMotionEstimator"}
CONTROLLERS = {"face-target": "law:FaceTarget"}
#: What turns the robot where the scenario does not say.
ESTIMATOR, CONTROLLER = "planar-motion", "face-target"
