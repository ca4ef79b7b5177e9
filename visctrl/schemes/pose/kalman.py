"""The source's three-state filters on filterpy: extended and unscented."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
from numpy.typing import NDArray

from visctrl.robots.unicycle import exact_jacobians, step_exact, wrap_angle
from visctrl.schemes.pose.measurements import Measured, MeasurementModel

Array = NDArray[np.float64]


class PoseFilter(ABC):
    """A filter for (x, y, φ) with exchangeable measurements."""

    @abstractmethod
    def predict(self, v: float, omega: float, dt: float, offset: float, noise: Array) -> None:
        """Follow a velocity; ``noise`` (2, 2) is the covariance of what was executed about it."""

    @abstractmethod
    def update(self, measured: Measured, model: MeasurementModel, gate: float) -> float | None:
        """Use a measurement; return its normalised innovation squared.

        One whose normalised innovation squared exceeds ``gate`` is left out: None.
        """

    @property
    @abstractmethod
    def pose(self) -> Array:
        """The estimate (3,)."""

    @property
    @abstractmethod
    def covariance(self) -> Array:
        """Its covariance (3, 3)."""


class ExtendedPoseFilter(PoseFilter):
    """Extended Kalman filter (A.9), (A.10)."""

    def __init__(self, pose: Array, covariance: Array) -> None:
        self._filter = _Extended(pose, covariance)

    def predict(self, v: float, omega: float, dt: float, offset: float, noise: Array) -> None:
        """Follow the exact arc, with its own Jacobians (see the contract)."""
        ekf = self._filter
        F, G = exact_jacobians(ekf.x, v, omega, dt, offset)
        ekf.F, ekf.Q = F, G @ noise @ G.T
        ekf.after = step_exact(ekf.x, v, omega, dt, offset)
        ekf.predict()

    def update(self, measured: Measured, model: MeasurementModel, gate: float) -> float | None:
        """Use a measurement by the exact derivatives of its model (see the contract)."""
        ekf = self._filter
        value, H = model.predict(ekf.x)
        innovation = model.residual(measured.values, value)
        S = H @ ekf.P @ H.T + measured.covariance
        nis = float(innovation @ np.linalg.solve(S, innovation))
        if nis > gate:
            return None
        ekf.update(
            innovation,
            HJacobian=lambda x: H,
            Hx=lambda x: np.zeros(len(innovation)),
            R=measured.covariance,
        )
        ekf.x[2] = wrap_angle(ekf.x[2])
        return nis

    @property
    def pose(self) -> Array:
        """The estimate (3,)."""
        return np.asarray(self._filter.x, dtype=np.float64)

    @property
    def covariance(self) -> Array:
        """Its covariance (3, 3)."""
        return np.asarray(self._filter.P, dtype=np.float64)


class UnscentedPoseFilter(PoseFilter):
    """Unscented Kalman filter: no derivatives, sigma points instead."""

    def __init__(self, pose: Array, covariance: Array) -> None:
        points = MerweScaledSigmaPoints(3, alpha=0.5, beta=2.0, kappa=0.0, subtract=_pose_residual)
        self._filter = UnscentedKalmanFilter(
            dim_x=3,
            dim_z=1,
            dt=1.0,
            hx=_no_model,
            fx=_no_model,
            points=points,
            x_mean_fn=_pose_mean,
            residual_x=_pose_residual,
        )
        self._filter.x, self._filter.P = pose.copy(), covariance.copy()

    def predict(self, v: float, omega: float, dt: float, offset: float, noise: Array) -> None:
        """Follow the exact arc (see the contract)."""
        ukf = self._filter
        _, G = exact_jacobians(ukf.x, v, omega, dt, offset)
        # A hair of noise keeps the covariance definite while the robot stands.
        ukf.Q = G @ noise @ G.T + 1e-14 * np.eye(3)
        ukf.predict(dt=dt, fx=lambda pose, step: step_exact(pose, v, omega, step, offset))

    def update(self, measured: Measured, model: MeasurementModel, gate: float) -> float | None:
        """Use a measurement through its sigma points (see the contract)."""
        ukf = self._filter
        centre, _ = model.predict(ukf.x)

        def mean(sigmas: Array, weights: Array) -> Array:
            around = np.array([model.residual(sigma, centre) for sigma in sigmas])
            return np.asarray(centre + weights @ around, dtype=np.float64)

        ukf.z_mean, ukf.residual_z = mean, model.residual
        before = ukf.x.copy(), ukf.P.copy()
        ukf.update(measured.values, R=measured.covariance, hx=lambda x: model.predict(x)[0])
        innovation = ukf.y
        nis = float(innovation @ ukf.SI @ innovation)
        if nis > gate:
            ukf.x, ukf.P = before
            return None
        ukf.P = 0.5 * (ukf.P + ukf.P.T)
        ukf.x[2] = wrap_angle(ukf.x[2])
        return nis

    @property
    def pose(self) -> Array:
        """The estimate (3,)."""
        return np.asarray(self._filter.x, dtype=np.float64)

    @property
    def covariance(self) -> Array:
        """Its covariance (3, 3)."""
        return np.asarray(self._filter.P, dtype=np.float64)


class _Extended(ExtendedKalmanFilter):  # type: ignore[misc]
    """filterpy's filter, whose own prediction is linear."""

    def __init__(self, pose: Array, covariance: Array) -> None:
        super().__init__(dim_x=3, dim_z=1)
        self.x, self.P = pose.copy(), covariance.copy()
        self.after = self.x

    def predict_x(self, u: float = 0.0) -> None:
        """Take the state that the exact motion leads to."""
        del u
        self.x = self.after


def _no_model(*_: object) -> Array:
    raise NotImplementedError("motion and measurement are given with every step")


def _pose_residual(a: Array, b: Array) -> Array:
    difference = np.asarray(a - b, dtype=np.float64)
    difference[..., 2] = wrap_angle(difference[..., 2])
    return difference


def _pose_mean(sigmas: Array, weights: Array) -> Array:
    """Return the weighted mean of poses (S, 3) about the first one."""
    around = np.array([_pose_residual(sigma, sigmas[0]) for sigma in sigmas])
    return np.asarray(sigmas[0] + weights @ around, dtype=np.float64)
