"""The constrained tensor fit of many robots at once: `visctrl.schemes.trifocal.constrained_fit` in arrays.

R robots, N features; the robots come first in every array. The equations and the constants are
those of the single fit, which is also what these functions are tested against.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from visctrl.geometry.trifocal.fit import CONVERGED, LONGEST_STEP, PACE, TINY, WIDTH
from visctrl.montecarlo.relation import Relation, Slopes
from visctrl.montecarlo.robots import Array, Index, Mask, taken

#: Rows of `Fits.rows`: derivatives by z, the residual, derivatives by the initial view.
_BY_Z, _RESIDUAL, _BY_INITIAL = slice(0, 4), 4, slice(5, 7)
_TINY = TINY * np.eye(4)


class Fits(NamedTuple):
    """R fits: see `visctrl.geometry.trifocal.fit.Fit`.

    z (R, 4), covariance (R, 4, 4), weights (R, N), spread (R,). rows (R, 7, N): derivatives of
    the residuals by z, the residuals themselves (rad), and room for what `couple` adds.
    """

    z: Array
    covariance: Array
    weights: Array
    spread: Array
    rows: Array
    slopes: Slopes

    @property
    def residuals(self) -> Array:
        """(R, N) in rad."""
        return self.rows[:, _RESIDUAL]

    def take(self, index: Index) -> Fits:
        """Return some of the fits."""
        return Fits(*taken(tuple(self), index))


class Couplings(NamedTuple):
    """R couplings to the initial views: see `visctrl.geometry.trifocal.fit.Coupling`.

    sensitivity (R, 4, 2), information (R, 2, 2), gradient (R, 2).
    """

    sensitivity: Array
    information: Array
    gradient: Array


def refine(
    relation: Relation, start: Array, sigma: Array, seen: Array, *, iterations: int = 20
) -> Fits:
    """Refine z (R, 4) from ``start``: see `visctrl.geometry.trifocal.fit.refine`.

    Every robot stops where it would stop alone. seen : (R, N), 1 where a feature is seen, else 0.
    """
    fits, far = _step(relation, start / _length(start)[:, None], sigma, seen)
    for _ in range(iterations - 1):
        if not far.any():
            break
        index = np.flatnonzero(far)
        again, still = _step(relation.take(index), fits.z[index], sigma[index], seen[index])
        for whole, part in zip(
            (*fits[:-1], *fits.slopes), (*again[:-1], *again.slopes), strict=True
        ):
            whole[index] = part
        far[index] = still
    return fits


def couple(relation: Relation, fits: Fits) -> Couplings:
    """Return the couplings to the initial views that ``relation`` takes for granted."""
    rows = fits.rows
    relation.by_initial(relation.products(fits.z), fits.slopes, rows[:, _BY_INITIAL])
    weights = fits.weights * (1.0 / fits.spread**2)[:, None]
    products = (rows[:, _BY_INITIAL] * weights[:, None]) @ rows.swapaxes(1, 2)
    mixed = products[:, :, _BY_Z]
    sensitivity = -fits.covariance @ mixed.swapaxes(1, 2)
    information = products[:, :, _BY_INITIAL] + mixed @ sensitivity
    return Couplings(sensitivity, information, -products[:, :, _RESIDUAL])


def _step(relation: Relation, z: Array, sigma: Array, seen: Array) -> tuple[Fits, Mask]:
    """Do one Gauss–Newton step; return the fits, and which robots have to go on."""
    residual, slopes = relation.linearised(relation.products(z))
    rows = np.empty((len(z), 7, residual.shape[1]))
    relation.jacobian(slopes, rows[:, _BY_Z])
    rows[:, _RESIDUAL] = residual
    spread = np.maximum(1.4826 * _median(np.abs(residual), seen), sigma)
    scaled = residual * (1.0 / (WIDTH * spread))[:, None]
    scaled *= scaled
    scaled += 1.0
    root = seen / scaled
    weights = root * root
    total = dot(root, root)
    curvature = 4.0 * dot(weights, root) - 3.0 * total
    convex = curvature > 0.0
    pace = np.minimum(np.where(convex, total / np.where(convex, curvature, 1.0), PACE), PACE)
    products = (rows[:, _BY_Z] * weights[:, None]) @ rows[:, :5].swapaxes(1, 2)
    information, gradient = products[:, :, :4], products[:, :, 4]
    across = _inverse_across(information, z)
    step = times(across, gradient)
    step *= -np.minimum(pace, LONGEST_STEP / np.maximum(_length(step), 1e-300))[:, None]
    z = z + step
    z /= _length(z)[:, None]
    length = np.sqrt(np.maximum(dot(step, times(information, step)), 0.0))
    rows[:, _RESIDUAL] += (step[:, None] @ rows[:, _BY_Z])[:, 0]
    covariance = (spread**2)[:, None, None] * across
    return Fits(z, covariance, weights, spread, rows, slopes), length >= CONVERGED * spread


def _median(values: Array, seen: Array) -> Array:
    """Return the middle one (R,) of each robot's values (R, N), of the features seen."""
    ordered = np.sort(np.where(seen > 0.0, values, np.inf), axis=1)
    middle = seen.sum(axis=1).astype(np.intp) // 2
    return np.asarray(ordered[np.arange(len(middle)), middle])


def _inverse_across(information: Array, z: Array) -> Array:
    """Return the pseudo-inverses (R, 4, 4) of informations whose null directions are z (R, 4)."""
    along = z[:, :, None] * z[:, None]
    size = (np.einsum("rii->r", information) + 1e-300)[:, None, None]
    across = np.linalg.inv(information + size * (along + _TINY))
    across -= along / size
    return np.asarray(across)


def _length(vectors: Array) -> Array:
    return np.asarray(np.sqrt(dot(vectors, vectors)))


def dot(one: Array, other: Array) -> Array:
    """Return the dot products (R,) of vectors (R, n)."""
    return np.asarray(np.einsum("rn,rn->r", one, other))


def times(matrices: Array, vectors: Array) -> Array:
    """Return matrices (R, m, n) times vectors (R, n)."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])
