"""Sliding-mode control on the 1D trifocal tensor (chapter 3 of the source)."""

from visctrl.schemes.scheme import Scheme

ESTIMATORS = {"tensor": "estimator:Tensor"}
CONTROLLERS = {
    "trifocal-smc": "law_smc:TrifocalSmc",
    "trifocal-smooth": "law_smooth:TrifocalSmooth",
    "trifocal-super-twisting": "law_super_twisting:TrifocalSuperTwisting",
}
SCHEME = Scheme(
    "1D trifocal tensor control",
    estimator="tensor",
    controller="trifocal-smc",
)
