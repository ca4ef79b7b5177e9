"""Where the current view lies between two fixed ones, from the features' parallax.

The lines through the epipoles meet at a flat angle when the start lies nearly on the target's
axis, and the noise of the fixed views' epipoles, the same in every tick, then costs far starts
centimetres along it. How far the features themselves have moved tells the same and better: the two
fixed views give each one's distance, in units of their baseline, and the current view is placed
among them. At the target the distances do not matter, for the images coincide.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from visctrl.geometry.planar import rotate_to_a

Array = NDArray[np.float64]

#: Features whose distance is less certain than this part of it are left out.
_MAX_RANGE_SD = 0.3
#: Fewer features than this do not place a view.
_LEAST_FEATURES = 8
#: Steps at most, and the one, as a part of the distance from the target, after which all is said.
_STEPS, _STILL = 4, 0.01
#: Least eigenvalue of the information as a part of the largest.
_REGULAR = 1e-12
#: Scale of the Cauchy kernel, in standard deviations of a residual.
_KERNEL_SIGMAS = 2.0
#: What the fixed views' own geometry costs, as a part of the distance from the target.
_FIXED_SHARE = 0.01


class Placed(NamedTuple):
    """Position (2,) of a view in the target's frame, in baselines of the fixed views."""

    position: Array
    covariance: Array


class _Features(NamedTuple):
    """What the fixed views tell of the features, and where the current view sees them.

    points : (2N, 3), in the target's frame, each twice.
    tangents : (2N, 3), across the current rays in that frame: all sideways, then all upwards.
    turn : (2N,), what a turn of the current view adds to the residuals.
    ranges, doubts : (2N,), distances from the target, and how their deviations show sideways and
        upwards.
    """

    points: Array
    tangents: Array
    turn: Array
    ranges: Array
    doubts: Array


def place_view(
    rays: tuple[Array, Array, Array],
    reference: tuple[float, float, float],
    start: tuple[float, float, float],
    sigma: float,
) -> Placed | None:
    """Return where the current view is, or None where the features do not tell.

    Parameters
    ----------
    rays : three (N, 3) arrays
        Unit rays (right, forward, up) of the same features in the target, reference and current
        view.
    reference : (x, y, phi)
        Pose of the reference view in the target's frame, |(x, y)| = 1.
    start : (x, y, phi)
        About where the current view is, in the same units.
    sigma : float
        Standard deviation of one ray's direction (rad).
    """
    features = _locate(rays, reference, start[2], sigma)
    if len(features.ranges) < 2 * _LEAST_FEATURES:
        return None
    position, information = np.array(start[:2]), np.eye(3)
    for _ in range(_STEPS):
        residual, jacobian, sd = _residuals(features, position, sigma)
        scaled = residual / sd
        middle = len(scaled) // 2
        usual = 1.4826 * float(np.partition(np.abs(scaled), middle)[middle])
        spread = max(1.0, usual)
        weights = 1.0 / (spread * sd) ** 2 / (1.0 + (scaled / (_KERNEL_SIGMAS * spread)) ** 2)
        information = (jacobian * weights[:, None]).T @ jacobian
        known = np.linalg.eigvalsh(information)
        if known[0] <= _REGULAR * known[-1]:
            return None
        step = np.linalg.solve(information, (weights * residual) @ jacobian)[:2]
        position = position - step
        if float(step @ step) < _STILL**2 * float(position @ position):
            break
    covariance = np.linalg.inv(information)[:2, :2]
    own = (_FIXED_SHARE * float(np.linalg.norm(position))) ** 2 * np.eye(2)
    return Placed(position, np.asarray(covariance + own))


def _locate(
    rays: tuple[Array, Array, Array],
    reference: tuple[float, float, float],
    phi: float,
    sigma: float,
) -> _Features:
    """Return the features that the target and the reference view place in space."""
    target, current = rays[0], rotate_to_a(rays[2], phi)
    other = rotate_to_a(rays[1], reference[2])
    baseline = np.array([[reference[0], reference[1], 0.0]])
    normal = np.cross(target, other)
    sine2 = np.maximum(np.sum(normal * normal, axis=1), 1e-18)
    # λ a − μ b = baseline, in the least-squares sense.
    here = np.sum(np.cross(baseline, other) * normal, axis=1) / sine2
    there = np.sum(np.cross(baseline, target) * normal, axis=1) / sine2
    range_sd = sigma * np.hypot(here, there) / np.sqrt(sine2)
    good = (here > 0.0) & (there > 0.0) & (range_sd < _MAX_RANGE_SD * here)
    target, current = target[good], current[good]
    here, range_sd = here[good], range_sd[good]
    right, forward, up = current.T
    level = np.maximum(np.hypot(right, forward), 1e-9)
    s, c, zero = right / level, forward / level, np.zeros(len(level))
    tangents = np.concatenate(
        [np.stack([c, -s, zero], axis=-1), np.stack([-s * up, -c * up, level], axis=-1)]
    )
    along = np.concatenate([target, target])
    return _Features(
        np.concatenate([here, here])[:, None] * along,
        tangents,
        np.concatenate([level, zero]),
        np.concatenate([here, here]),
        np.sum(tangents * along, axis=1) * np.concatenate([range_sd, range_sd]),
    )


def _residuals(features: _Features, position: Array, sigma: float) -> tuple[Array, Array, Array]:
    """Return how far (rad) points lie beside their rays, ∂/∂(x, y, turn), and the deviations."""
    way = features.points - np.array([position[0], position[1], 0.0])
    nearness = 1.0 / np.maximum(np.sqrt(np.sum(way * way, axis=1)), 1e-9)
    residual = np.sum(features.tangents * way, axis=1) * nearness
    jacobian = np.column_stack([-features.tangents[:, :2] * nearness[:, None], features.turn])
    variance = sigma**2 * (1.0 + (features.ranges * nearness) ** 2)
    return residual, jacobian, np.sqrt(variance + (features.doubts * nearness) ** 2)
