"""The gain conditions of the epipolar sliding-mode law: (2.22), (2.23) and (2.25).

A margin is the left side minus the right side of a condition: positive where the surface is
attractive in spite of a wrong focal length and a wrong distance. Epipoles are for a unit focal
length; ``focal_ratio`` is αx/αe, the true focal length over the one that the rays assume.
Everything broadcasts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


class DecouplingMargins(NamedTuple):
    """Margins (1/s) of (2.22): of the current and of the target epipole's surface."""

    current: Array
    target: Array


class BoundedMargins(NamedTuple):
    """Margins of (2.23): of ω (rad/s) for the current, of v (m/s) for the target epipole."""

    omega: Array
    v: Array


def decoupling_margins(
    surfaces: tuple[ArrayLike, ArrayLike],
    rates: tuple[ArrayLike, ArrayLike],
    angles: tuple[ArrayLike, ArrayLike],
    kappas: tuple[float, float],
    lambdas: tuple[float, float],
    *,
    distance_ratio: ArrayLike,
    focal_ratio: ArrayLike = 1.0,
) -> DecouplingMargins:
    """Return the margins of (2.22) for the decoupling law.

    Parameters
    ----------
    surfaces : pair of (...) arrays
        s_c and s_t.
    rates : pair of (...) arrays
        Rates of the references, ė23d and ė32d (1/s).
    angles : pair of (...) arrays
        q = φ − ψ and ψ (rad).
    kappas, lambdas : pairs of float
        (κc, κt) and (λc, λt).
    distance_ratio : (...) array
        d23e/d23, the assumed distance over the true one.
    focal_ratio : (...) array
        αx/αe.
    """
    s_c, s_t = (np.asarray(s, dtype=np.float64) for s in surfaces)
    rate_c, rate_t = (np.asarray(r, dtype=np.float64) for r in rates)
    q, psi = (np.asarray(a, dtype=np.float64) for a in angles)
    distance = np.asarray(distance_ratio, dtype=np.float64)
    focal = np.asarray(focal_ratio, dtype=np.float64)
    u_t = rate_t - kappas[1] * np.sign(s_t) - lambdas[1] * s_t
    coupling = (np.cos(psi) / np.cos(q)) ** 2
    A = focal * (distance - 1.0) * coupling * u_t + (focal - 1.0) * rate_c
    B = (focal * distance - 1.0) * rate_t
    return DecouplingMargins(
        kappas[0] + lambdas[0] * np.abs(s_c) - np.abs(A) / focal,
        kappas[1] + lambdas[1] * np.abs(s_t) - np.abs(B) / (focal * distance),
    )


def bounded_margins(
    rates: tuple[ArrayLike, ArrayLike],
    angles: tuple[ArrayLike, ArrayLike],
    gains: tuple[float, float],
    *,
    distance: ArrayLike,
    focal_ratio: ArrayLike = 1.0,
) -> BoundedMargins:
    """Return the margins of (2.23) for the bounded law.

    Parameters
    ----------
    rates, angles, focal_ratio
        As for `decoupling_margins`.
    gains : pair of float
        kυ (m/s) and kω (rad/s).
    distance : (...) array
        True distance to the target (m). On the singularity itself (q = 0) no finite gain
        does: the margin of v is −inf unless the reference rests.
    """
    rate_c, rate_t = (np.abs(np.asarray(r, dtype=np.float64)) for r in rates)
    q, psi = (np.asarray(a, dtype=np.float64) for a in angles)
    d = np.asarray(distance, dtype=np.float64)
    focal = np.asarray(focal_ratio, dtype=np.float64)
    b = np.abs(np.sin(q))
    k_v, k_omega = gains
    with np.errstate(divide="ignore"):
        needed_v = np.where(rate_t > 0.0, d * np.cos(psi) ** 2 * rate_t / (focal * b), 0.0)
    return BoundedMargins(
        k_omega - (k_v * b / d + np.cos(q) ** 2 * rate_c / focal),
        k_v - needed_v,
    )


def depth_margin(
    error: ArrayLike,
    k0: float,
    k1: float,
    *,
    distance_ratio: ArrayLike,
    focal_ratio: ArrayLike = 1.0,
) -> Array:
    """Return the margin (1/s) of (2.25) for the depth step.

    Parameters
    ----------
    error : (...) array
        ξ12 = e12 − e13.
    k0, k1 : float
        Integral and switching gain (1/s).
    distance_ratio : (...) array
        d12e/d12, the assumed distance over the true one.
    focal_ratio : (...) array
        αx/αe.
    """
    ratio = np.asarray(focal_ratio, dtype=np.float64) * np.asarray(distance_ratio, dtype=np.float64)
    D = (1.0 - ratio) * k0 * np.asarray(error, dtype=np.float64)
    return np.asarray(k1 - np.abs(D) / ratio)
