"""Planar motion between two views of unit rays: its essential matrix, found robustly.

View A is the reference. Rays are (right, forward, up) in each view's own axes. View B has the
heading φ (counter-clockwise) and its centre is seen from A at the bearing θ (clockwise from
forward), so that for a point seen along a and b

    aᵀ E b = 0,   E = [0 0 cos θ; 0 0 −sin θ; −cos α  sin α  0],   α = θ + φ.

α is the bearing of the baseline in B's axes. E knows θ up to π (the sign comes from points
lying in front of both views). It uses elevations, so it needs a calibrated camera; features at
the camera's own height say nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robots.unicycle import wrap_angle
from visctrl.geometry.parallax import signed_parallax
from visctrl.plugins import Health

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Why a motion is degenerate: the baseline does not stand out of the noise.
IDENTICAL = "views identical: the direction of the baseline is not determined"
#: Fewer correspondences than this leave no residual to judge a motion by.
MINIMUM_FEATURES = 4
#: Scale of the soft-L1 kernel in standard deviations of the residual.
KERNEL_SIGMAS = 1.5
#: A baseline shows when its information exceeds the noise's by this many standard deviations.
BASELINE_SIGNIFICANCE = 5.0
#: A feature's parallax is at most this many times the usual one.
NEAREST = 10.0
#: Noise of the θ column (in σ²) up to which a feature always says something about the direction,
#: and the multiple of the usual noise up to which it does where all have more.
MAX_NOISE, USUAL_NOISE = 4.0, 10.0
#: Standard deviations (rad) beyond which a motion counts as undetermined.
MAX_PHI_SD, MAX_DIRECTION_SD = 0.2, 0.5
#: A step shorter than this part of a ray's noise ends a descent.
STILL = 1e-2
#: After a step shorter than this many times a ray's noise, the next is Newton's.
NEAR = 10.0
#: Variance of a direction of which nothing is known (uniform on the circle).
_UNKNOWN_DIRECTION = np.pi**2 / 3.0


@dataclass(frozen=True)
class PlanarMotion:
    """Pose of view B in view A up to the length of the baseline.

    phi : heading of B in A's frame (rad, counter-clockwise).
    direction : bearing in A of B's centre (rad, clockwise from forward, in (−π, π]).
    covariance : (2, 2), of (phi, direction) (rad²); infinite where nothing was measured.
    inliers : (N,) features that agree with the motion.
    health : ``DEGENERATE`` with the reason when something is not determined; with identical
        views ``phi`` is still valid and only ``direction`` is not.
    """

    phi: float
    direction: float
    covariance: Array
    inliers: Mask
    health: Health = Health.OK
    reason: str = ""

    @property
    def phi_sd(self) -> float:
        """Standard deviation of ``phi`` (rad)."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def direction_sd(self) -> float:
        """Standard deviation of ``direction`` (rad)."""
        return float(np.sqrt(self.covariance[1, 1]))


class _Linearised(NamedTuple):
    """Sampson residuals (rad) and their derivatives by (φ, θ)."""

    residual: Array
    jacobian: Array
    #: Variance of the θ column that is due to pixel noise alone, in units of σ².
    noise: Array


def essential_matrix(phi: ArrayLike, direction: ArrayLike) -> Array:
    """Return E (..., 3, 3) with aᵀ E b = 0 for a motion (rad), broadcast over both."""
    phi, theta = np.broadcast_arrays(np.asarray(phi, float), np.asarray(direction, float))
    alpha = theta + phi
    E = np.zeros((*phi.shape, 3, 3))
    E[..., 0, 2], E[..., 1, 2] = np.cos(theta), -np.sin(theta)
    E[..., 2, 0], E[..., 2, 1] = -np.cos(alpha), np.sin(alpha)
    return E


def rotate_to_a(rays_b: ArrayLike, phi: float) -> Array:
    """Return rays (..., 3) of view B turned into A's axes."""
    b = np.asarray(rays_b, dtype=np.float64)
    s, c = np.sin(phi), np.cos(phi)
    return np.stack([c * b[..., 0] - s * b[..., 1], s * b[..., 0] + c * b[..., 1], b[..., 2]], -1)


def sampson_residuals(
    rays_a: ArrayLike, rays_b: ArrayLike, phi: float, direction: float
) -> tuple[Array, Array]:
    """Return the Sampson residuals (N,) in rad of unit rays (N, 3), and ∂/∂(φ, θ) (N, 2).

    The residual is the algebraic error over the norm of its gradient by both rays: to first
    order its standard deviation is that of one ray's direction.
    """
    linear = _linearise(np.asarray(rays_a), np.asarray(rays_b), phi, direction)
    return linear.residual, linear.jacobian


def ransac_planar_motion(
    rays_a: ArrayLike,
    rays_b: ArrayLike,
    sigma: float,
    *,
    seed: int = 0,
    threshold_sigmas: float = 4.0,
    hypotheses: int = 400,
) -> PlanarMotion:
    """Find the planar motion that most features agree with, and refine it on them.

    Two features fix the motion up to two solutions; all hypotheses are scored in one array
    operation by the truncated sum of squared Sampson residuals.

    Parameters
    ----------
    rays_a, rays_b : (N, 3) arrays
        Unit rays of the same features in both views.
    sigma : float
        Standard deviation of one ray's direction (rad).
    seed : int
        Of the random samples; the same seed gives the same result.
    threshold_sigmas : float
        Residual (in ``sigma``) beyond which a feature counts as an outlier.
    hypotheses : int
        Number of two-point samples.
    """
    a, b = np.asarray(rays_a, dtype=np.float64), np.asarray(rays_b, dtype=np.float64)
    if len(a) < MINIMUM_FEATURES:
        return _too_few(len(a))
    rng = np.random.default_rng(seed)
    first = rng.integers(0, len(a), hypotheses)
    second = (first + rng.integers(1, len(a), hypotheses)) % len(a)
    sample = np.stack([first, second], axis=-1)
    theta, alpha = two_point_motions(a[sample], b[sample])
    limit = threshold_sigmas * sigma
    squared = squared_residuals(a, b, theta, alpha)
    best = int(np.argmin(np.minimum(squared, limit**2).sum(axis=1)))
    phi, direction = float(alpha[best] - theta[best]), float(theta[best])
    direction = _towards_points(a, b, phi, direction, sigma)
    inliers = (squared[best] < limit**2) & _plausible(a, b, phi, direction, limit)
    motion = _too_few(len(a))
    for _ in range(2):
        if inliers.sum() < MINIMUM_FEATURES:
            return _too_few(len(a), int(inliers.sum()))
        motion = refine_planar_motion(a[inliers], b[inliers], phi, direction, sigma)
        phi, direction = motion.phi, motion.direction
        residual, _ = sampson_residuals(a, b, phi, direction)
        inliers = (np.abs(residual) < limit) & _plausible(a, b, phi, direction, limit)
    return PlanarMotion(phi, direction, motion.covariance, inliers, motion.health, motion.reason)


def refine_planar_motion(
    rays_a: ArrayLike,
    rays_b: ArrayLike,
    phi0: float,
    direction0: float,
    sigma: float,
    *,
    iterations: int = 15,
) -> PlanarMotion:
    """Refine a planar motion from a start by soft-L1 Gauss–Newton on Sampson residuals.

    Parameters
    ----------
    rays_a, rays_b : (N, 3) arrays
        Unit rays of the same features in both views; some may be outliers.
    phi0, direction0 : float
        Where to start (rad); the sign of the direction is found anew.
    sigma : float
        Standard deviation of one ray's direction (rad).
    iterations : int
        At most this many steps.
    """
    a, b = np.asarray(rays_a, dtype=np.float64), np.asarray(rays_b, dtype=np.float64)
    if len(a) < MINIMUM_FEATURES:
        return _too_few(len(a))
    phi, direction = _descend(a, b, (phi0, direction0), sigma, iterations)
    linear = _linearise(a, b, phi, direction)
    scaled = linear.residual / sigma
    weights = _soft_l1_weights(scaled)
    # Residuals larger than promised widen the covariance; smaller ones do not narrow it.
    spread = max(1.0, 1.4826 * float(np.median(np.abs(scaled))))
    covariance, reason = _covariance(linear, weights, sigma, spread)
    direction = _towards_points(a, b, phi, direction, sigma)
    return PlanarMotion(
        float(wrap_angle(phi)),
        direction,
        covariance,
        np.abs(scaled) < 3.0 * spread,
        Health.DEGENERATE if reason else Health.OK,
        reason,
    )


def two_point_motions(a: Array, b: Array) -> tuple[Array, Array]:
    """Return (θ, α) (2H,) of the motions through samples (H, 2, 3).

    With m = (cos θ, sin θ), n = (cos α, sin α) the constraints read P m + Q n = 0, so that
    m = W n with W = −P⁻¹Q; |m| = |n| = 1 is an equation in cos 2α, sin 2α.
    """
    P = b[..., 2:3] * a[..., :2] * [1.0, -1.0]
    Q = a[..., 2:3] * b[..., :2] * [-1.0, 1.0]
    det = P[:, 0, 0] * P[:, 1, 1] - P[:, 0, 1] * P[:, 1, 0]
    det = np.where(np.abs(det) > 1e-300, det, 1e-300)
    adjugate = np.stack([P[:, 1, 1], -P[:, 0, 1], -P[:, 1, 0], P[:, 0, 0]], axis=-1).reshape(
        -1, 2, 2
    )
    W = -(adjugate @ Q) / det[:, None, None]
    S = np.swapaxes(W, 1, 2) @ W
    mean, half, cross = (S[:, 0, 0] + S[:, 1, 1]) / 2, (S[:, 0, 0] - S[:, 1, 1]) / 2, S[:, 0, 1]
    amplitude = np.maximum(np.hypot(half, cross), 1e-300)
    # Outside [−1, 1] no motion fits exactly; the nearest one is kept (vanishing baseline).
    opening = np.arccos(np.clip((1.0 - mean) / amplitude, -1.0, 1.0))
    centre = np.arctan2(cross, half)
    alpha = np.concatenate([centre + opening, centre - opening]) / 2.0
    W = np.concatenate([W, W])
    c, s = np.cos(alpha), np.sin(alpha)
    theta = np.arctan2(W[:, 1, 0] * c + W[:, 1, 1] * s, W[:, 0, 0] * c + W[:, 0, 1] * s)
    return theta, alpha


def squared_residuals(a: Array, b: Array, theta: Array, alpha: Array) -> Array:
    """Return squared Sampson residuals (H, N) of H motions for N features."""
    A = np.outer(np.cos(theta), a[:, 0]) - np.outer(np.sin(theta), a[:, 1])
    B = np.outer(np.sin(alpha), b[:, 1]) - np.outer(np.cos(alpha), b[:, 0])
    error = b[:, 2] * A + a[:, 2] * B
    gradient = a[:, 2] ** 2 + b[:, 2] ** 2 + A * A + B * B
    return np.asarray(error * error / np.maximum(gradient, 1e-18), dtype=np.float64)


def _linearise(a: Array, b: Array, phi: float, direction: float) -> _Linearised:
    theta, alpha = direction, direction + phi
    st, ct, sa, ca = np.sin(theta), np.cos(theta), np.sin(alpha), np.cos(alpha)
    A, dA = np.array([[ct, -st], [-st, -ct]]) @ a[:, :2].T
    B, dB = np.array([[-ca, sa], [sa, ca]]) @ b[:, :2].T
    up = a[:, 2] ** 2 + b[:, 2] ** 2
    gradient2 = np.maximum(up + A * A + B * B, 1e-18)
    gradient = np.sqrt(gradient2)
    residual = (b[:, 2] * A + a[:, 2] * B) / gradient
    by_theta = (b[:, 2] * dA - residual * A * dA / gradient) / gradient
    by_alpha = (a[:, 2] * dB - residual * B * dB / gradient) / gradient
    # α = θ + φ, so φ moves α only and θ moves both.
    jacobian = np.stack([by_alpha, by_theta + by_alpha], axis=-1)
    return _Linearised(residual, jacobian, (up + dA * dA + dB * dB) / gradient2)


def _soft_l1_weights(scaled: Array) -> Array:
    return np.asarray(1.0 / np.sqrt(1.0 + (scaled / KERNEL_SIGMAS) ** 2), dtype=np.float64)


def _soft_l1_cost(scaled: Array) -> float:
    return float(np.sum(np.sqrt(1.0 + (scaled / KERNEL_SIGMAS) ** 2) - 1.0))


def _descend(
    a: Array, b: Array, start: tuple[float, float], sigma: float, iterations: int
) -> tuple[float, float]:
    """Return the (φ, θ) that Levenberg–Marquardt reaches from ``start``."""
    phi, direction = start
    linear = _linearise(a, b, phi, direction)
    cost, damping, newton = _soft_l1_cost(linear.residual / sigma), 1e-3, False
    for _ in range(iterations):
        step_phi, step_direction = _step(linear, sigma, damping, newton)
        longest = max(abs(step_phi), abs(step_direction))
        # A direction without information must not jump round the circle.
        shorter = min(1.0, 0.5 / max(longest, 1e-12))
        ahead = phi + shorter * step_phi, direction + shorter * step_direction
        trial = _linearise(a, b, *ahead)
        trial_cost = _soft_l1_cost(trial.residual / sigma)
        if trial_cost > cost:
            if longest < STILL * sigma:
                break
            damping, newton = max(damping, 1e-6) * 10.0, False
            continue
        (phi, direction), linear, cost = ahead, trial, trial_cost
        damping, newton = damping * 0.1, longest < NEAR * sigma
        if longest < STILL * sigma:
            break
    return phi, direction


def _step(linear: _Linearised, sigma: float, damping: float, newton: bool) -> tuple[float, float]:
    """Return the damped step of (φ, θ): Newton's, or the shorter one of reweighted squares."""
    weights = _soft_l1_weights(linear.residual / sigma)
    # The kernel's own curvature is w³; far out that would overshoot.
    curvature = weights * np.maximum(weights * weights, 0.5) if newton else weights
    J = linear.jacobian
    H = (J * curvature[:, None]).T @ J
    g = (weights * linear.residual) @ J
    pp, tt = float(H[0, 0]) * (1.0 + damping) + 1e-12, float(H[1, 1]) * (1.0 + damping) + 1e-12
    pt = float(H[0, 1])
    # Damped on its diagonal, H is positive definite.
    det = pp * tt - pt * pt
    return (pt * float(g[1]) - tt * float(g[0])) / det, (pt * float(g[0]) - pp * float(g[1])) / det


def _covariance(
    linear: _Linearised, weights: Array, sigma: float, spread: float
) -> tuple[Array, str]:
    """Return the covariance of (φ, θ) and the name of the degeneracy, if any."""
    J = linear.jacobian
    variance = (sigma * spread) ** 2
    info = (weights[:, None] * J).T @ J / variance
    if info[0, 0] * MAX_PHI_SD**2 < 1.0:
        return np.diag([np.inf, np.inf]), "features clustered, or level with the camera"
    significance, direction_info = _direction_information(linear, weights, variance)
    if significance < BASELINE_SIGNIFICANCE:
        alone = np.diag([1.0 / info[0, 0], _UNKNOWN_DIRECTION])
        return alone, IDENTICAL
    coupling = info[0, 1] / info[0, 0]
    v = 1.0 / max(direction_info - coupling * info[0, 1], 1e-12)
    covariance = np.array([[1.0 / info[0, 0] + coupling**2 * v, -coupling * v], [-coupling * v, v]])
    if covariance[0, 0] > MAX_PHI_SD**2 or v > MAX_DIRECTION_SD**2:
        return covariance, "features clustered: they do not separate turning from moving"
    return covariance, ""


def _direction_information(
    linear: _Linearised, weights: Array, variance: float
) -> tuple[float, float]:
    """Return how many sigmas the baseline stands out of the noise, and what θ is known by.

    With a short baseline the noise itself makes the θ column non-zero; its share is taken out
    of the information, or the direction would look known when it is not. Rays along the
    baseline and level with the camera have a column of mostly noise, for a perspective camera
    that drives ahead nearly all of them: each counts in the test by how little of it is.
    """

    def debiased(w: Array) -> tuple[float, float]:
        signal = float(np.sum(w * (linear.jacobian[:, 1] ** 2 / variance - linear.noise)))
        return signal, np.sqrt(2.0 * float(np.sum((w * linear.noise) ** 2)))

    shown, doubt = debiased(weights / (1.0 + linear.noise))
    loud = max(MAX_NOISE, USUAL_NOISE * float(np.median(linear.noise)))
    sure, _ = debiased(np.where(linear.noise < loud, weights, 0.0))
    everything, doubt_everything = debiased(weights)
    return shown / max(doubt, 1e-12), max(sure, everything - 2.0 * doubt_everything)


def _towards_points(a: Array, b: Array, phi: float, direction: float, sigma: float) -> float:
    """Return ``direction`` or its opposite: the one that puts points in front of both views."""
    # Far points vote with less weight, gross errors with no more than a good point.
    votes = np.tanh(signed_parallax(a, b, phi, direction) / max(3.0 * sigma, 1e-12))
    return float(wrap_angle(direction if votes.sum() >= 0.0 else direction + np.pi))


def _plausible(a: Array, b: Array, phi: float, direction: float, limit: float) -> Mask:
    """Return whether each feature's parallax (N,) is one that a point of the scene can have.

    An outlier that happens to lie near its epipolar plane passes the residual test, and with a
    short baseline its huge parallax would outweigh all others.
    """
    parallax = signed_parallax(a, b, phi, direction)
    usual = float(np.median(np.abs(parallax)))
    return np.asarray((parallax > -2.0 * limit) & (parallax < max(NEAREST * usual, 2.0 * limit)))


def _too_few(count: int, agreeing: int | None = None) -> PlanarMotion:
    found = f"{count} features" if agreeing is None else f"{agreeing} of {count} features agree"
    return PlanarMotion(
        0.0,
        0.0,
        np.diag([np.inf, np.inf]),
        np.zeros(count, dtype=np.bool_),
        Health.LOST,
        f"too few features: {found}, {MINIMUM_FEATURES} are needed",
    )
