"""The source's three-state pose filters on filterpy, extended and unscented, and what they measure.

A model turns views into epipoles or elements of the 1D trifocal tensor with their covariance, and
predicts the same numbers with their exact derivatives from a pose of the camera in the target's
frame.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
from numpy.typing import ArrayLike, NDArray

from visctrl.contracts import Views
from visctrl.geometry.pose_outputs import epipole_bearings, normalised_elements
from visctrl.geometry.trifocal.fit import refine
from visctrl.geometry.trifocal.solvers import (
    identical_views,
    linear_covariance,
    ransac_tensor,
    solve_linear,
)
from visctrl.geometry.trifocal.tensor import (
    CALIBRATED,
    ELEMENTS,
    Trilinear,
    current_view_basis,
    normalised,
    normalised_covariance,
    sampson_residuals,
    target_in_view,
    trilinear,
    view_parameters,
)
from visctrl.geometry.trifocal.transfer import wrap_half_turn
from visctrl.geometry.two_view.planar import ransac_planar_motion, refine_planar_motion
from visctrl.robots.unicycle import exact_jacobians, step_exact, wrap_angle

Array = NDArray[np.float64]
TensorMethod = Literal["linear", "refined", "known"]

#: Residuals beyond this many standard deviations are errors, not noise.
_OUTLIER = 4.0
#: Epipoles less certain than this (rad) are of no use.
_MAX_EPIPOLE_SD = 0.1


class Measured(NamedTuple):
    """Numbers (m,) that were measured, and their covariance (m, m)."""

    values: Array
    covariance: Array


@dataclass(frozen=True)
class NotMeasured:
    """Why views tell nothing."""

    reason: str


class MeasurementModel(ABC):
    """One kind of measurement."""

    @abstractmethod
    def measure(self, views: Views, pose: Array) -> Measured | NotMeasured:
        """Return what the views tell, or why they tell nothing.

        pose : (3,) where the camera is about, for a choice between measurements.
        """

    @abstractmethod
    def predict(self, pose: ArrayLike) -> tuple[Array, Array]:
        """Return the numbers (..., m) for poses (..., 3), and their derivatives (..., m, 3)."""

    def residual(self, a: Array, b: Array) -> Array:
        """Return the difference of two vectors of such numbers."""
        return np.asarray(a - b, dtype=np.float64)


# --- tensor ----------------------------------------------------------------------------------


class TensorModel(MeasurementModel):
    """Elements of the 1D trifocal tensor over T121.

    Parameters
    ----------
    initial : (3,) array
        C1, taken for exact.
    elements : names of the elements, without T121.
    method : ``linear``, the least algebraic error over calibrated tensors, as published;
        ``refined``, the least bearing residuals over them; ``known``, the same over the tensors
        that have this C1.
    seed : of the search for outliers.
    """

    def __init__(
        self, initial: Array, elements: tuple[str, ...], *, method: TensorMethod, seed: int
    ) -> None:
        self._initial = initial
        self._which = [ELEMENTS.index(name) for name in elements]
        self._basis = CALIBRATED
        if method == "known":
            view = view_parameters(initial[2], target_in_view(initial))
            self._basis = current_view_basis(view)
        self._refined = method != "linear"
        self._seed = seed

    def measure(self, views: Views, pose: Array) -> Measured | NotMeasured:
        """Return the elements and their covariance (see the contract)."""
        del pose
        found = measured_tensor(views, self._basis, refined=self._refined, seed=self._seed)
        if isinstance(found, NotMeasured):
            return found
        T, covariance = found
        spread = normalised_covariance(T, covariance)
        return Measured(normalised(T)[self._which], spread[np.ix_(self._which, self._which)])

    def predict(self, pose: ArrayLike) -> tuple[Array, Array]:
        """Return the elements and their derivatives (see the contract)."""
        ratio, slope = normalised_elements(pose, self._initial)
        return ratio[..., self._which], slope[..., self._which, :]


def measured_tensor(
    views: Views, basis: Array, *, refined: bool, seed: int
) -> tuple[Array, Array] | NotMeasured:
    """Return the tensor (8,) of initial, current and target view and its covariance (8, 8).

    Parameters
    ----------
    views : Views
    basis : (8, k) array
        Of the family of tensors to search.
    refined : bool
        Whether to minimise bearing residuals instead of the algebraic error.
    seed : int
        Of the search for outliers.

    Returns
    -------
    tuple or NotMeasured
        The latter says why there is none.
    """
    unknowns = basis.shape[1]
    if len(views) < unknowns + 1:
        return NotMeasured(f"too few features: {len(views)}")
    if identical_views(views.initial, views.current, views.sigma):
        return NotMeasured("views identical: initial and current")
    relation = trilinear(views.initial, views.current, views.target).within(basis)
    relation = _agreeing(relation, views.sigma, seed)
    if len(relation) < unknowns:
        return NotMeasured(f"features disagree: {len(relation)} of {len(views)} fit one tensor")
    z = solve_linear(relation)
    if refined:
        fit = refine(relation, z, views.sigma)
        z, covariance = fit.z, fit.covariance
    else:
        covariance = linear_covariance(relation, z, views.sigma)
    return basis @ z, basis @ covariance @ basis.T


def _agreeing(relation: Trilinear, sigma: float, seed: int) -> Trilinear:
    """Return the features without outliers; a random search only where there seem to be any."""
    residual = sampson_residuals(relation, solve_linear(relation))
    if np.abs(residual).max() < _OUTLIER * sigma:
        return relation
    _, inliers = ransac_tensor(relation, sigma, seed=seed, threshold_sigmas=_OUTLIER)
    return relation.take(inliers)


# --- epipoles --------------------------------------------------------------------------------


class EpipoleModel(MeasurementModel):
    """Epipoles of the current view with the target view or, near it, with the initial one.

    Parameters
    ----------
    initial : (3,) array
        C1, taken for exact.
    both : the epipoles in both views of the pair, instead of the fixed view's alone.
    switch : distance to the target (m) from which on the initial view takes its place, as the
        baseline to the target vanishes there. It does so earlier where the target's epipoles
        can no longer be told.
    seed : of the search for outliers.
    """

    def __init__(self, initial: Array, *, both: bool, switch: float, seed: int) -> None:
        self._initial = initial
        self._rows = slice(0, 2 if both else 1)
        self._switch = switch
        self._seed = seed
        self._near = False
        self._reference = np.zeros(3)
        self._last: tuple[float, float] | None = None

    def measure(self, views: Views, pose: Array) -> Measured | NotMeasured:
        """Return the epipoles' bearings from the planar essential matrix."""
        self._near = self._near or float(np.hypot(pose[0], pose[1])) < self._switch
        if not self._near:
            found = self._measured(views, views.target, np.zeros(3))
            if not isinstance(found, NotMeasured):
                return found
        return self._measured(views, views.initial, self._initial)

    def _measured(self, views: Views, fixed: Array, reference: Array) -> Measured | NotMeasured:
        """Measure the pair of a fixed view, rays (N, 3) from ``reference``, and the current one."""
        if not np.array_equal(reference, self._reference):
            self._reference, self._last = reference, None
        motion = None
        if self._last is not None:
            motion = refine_planar_motion(fixed, views.current, *self._last, views.sigma)
        if motion is None or not motion.determined or motion.inliers.mean() < 0.6:
            motion = ransac_planar_motion(fixed, views.current, views.sigma, seed=self._seed)
        if not motion.determined:
            return NotMeasured(motion.reason)
        if motion.direction_sd > _MAX_EPIPOLE_SD:
            return NotMeasured(f"epipole known to {np.degrees(motion.direction_sd):.0f} deg only")
        self._last = (motion.phi, motion.direction)
        value = np.array([motion.direction, motion.direction + motion.phi])
        J = np.array([[0.0, 1.0], [1.0, 1.0]])
        covariance = J @ motion.covariance @ J.T
        return Measured(value[self._rows], covariance[self._rows, self._rows])

    def predict(self, pose: ArrayLike) -> tuple[Array, Array]:
        """Return the epipoles' bearings for the pair in use (see the contract)."""
        value, slope = epipole_bearings(pose, self._reference)
        return value[..., self._rows], slope[..., self._rows, :]

    def residual(self, a: Array, b: Array) -> Array:
        """Return the differences of undirected lines (rad)."""
        return wrap_half_turn(a - b)


# --- filters ---------------------------------------------------------------------------------


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
