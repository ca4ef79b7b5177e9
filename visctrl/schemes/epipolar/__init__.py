"""Sliding-mode control on the epipoles of three views (chapter 2 of the source)."""

from visctrl.schemes.scheme import Scheme

ESTIMATORS = {"epipoles": "estimator:Epipoles"}
CONTROLLERS = {
    "epipolar-smc": "law_smc:EpipolarSmc",
    "epipolar-smooth": "law_smooth:EpipolarSmooth",
}
SCHEME = Scheme(
    "epipolar control from three views",
    estimator="epipoles",
    controller="epipolar-smooth",
    approach=False,
    same_height=True,
)
