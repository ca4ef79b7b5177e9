"""EKF pose estimation and Cartesian tracking control (chapter 4 of the source)."""

from visctrl.schemes.scheme import Scheme

ESTIMATORS = {"transfer": "estimator:PoseTransfer", "ekf": "estimator_ekf:PoseEkf"}
CONTROLLERS = {"pose-tracking": "law:PoseTracking"}
SCHEME = Scheme(
    "pose estimation and Cartesian control",
    estimator="transfer",
    controller="pose-tracking",
    mount="front",
    approach=False,
)
