"""Pseudo-inverse control on the 2D trifocal tensor of planar motion, for comparison."""

from visctrl.schemes.scheme import Scheme

ESTIMATORS = {"tensor2d": "estimator:Tensor2d"}
CONTROLLERS = {"trifocal2d": "law:Trifocal2d"}
SCHEME = Scheme(
    "2D trifocal tensor and pseudo-inverse control",
    estimator="tensor2d",
    controller="trifocal2d",
    approach=False,
    same_height=True,
)
